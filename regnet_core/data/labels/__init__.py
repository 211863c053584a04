"""Grasp labels: grasps of single objects, what a scene leaves of them, and point confidence."""
