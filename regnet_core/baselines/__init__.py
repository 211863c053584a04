"""Grasp proposers that need no trained weights, and other published methods to compare with."""
