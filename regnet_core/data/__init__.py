"""Synthetic data: procedural objects, scenes dropped in physics, depth cameras and bags of their clouds."""
