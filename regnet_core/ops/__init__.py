"""Numerical kernels on point clouds: compiled at run time, no compiler needed at installation."""
