"""Depth cameras: poses, intrinsics, noise, and what they see of a scene."""
