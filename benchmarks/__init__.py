"""Benchmarks: what every stage of a detection costs, how near to the machine's peak it is, and what ROS adds.

`python -m benchmarks --help`, from the root of the repository; benchmarks/README.md explains what is measured and how.
"""

import os

# As the nodes and the detector do it, before any library that uses OpenMP is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
