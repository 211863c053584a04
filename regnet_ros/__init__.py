"""ROS 2 nodes of the grasp-detection suite: thin shells that convert, call one function of regnet_core and publish."""

import os

# OpenMP threads that spin while they wait make single calls up to 20 times slower where nodes share the cores; this has
# to be known before the first library that uses OpenMP is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
