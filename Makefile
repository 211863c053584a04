# `make demo` and `make test` do all set-up they need: the environment .venv, which needs git, Python 3.12 (or 3.11) with its
# modules venv and ensurepip and its headers, a C++ compiler and make. No ROS installation is needed or used.

VENV := $(CURDIR)/.venv
PY := $(VENV)/bin/python

# ROS processes find packages and messages in .venv, talk to this machine only and do not wait for work by spinning.
export AMENT_PREFIX_PATH := $(VENV)
export CMAKE_PREFIX_PATH := $(VENV)
export PATH := $(VENV)/bin:$(PATH)
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export OMP_WAIT_POLICY := PASSIVE
# What a sourced ROS installation or a running Python of another environment leaves behind would be mixed in.
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH COLCON_PREFIX_PATH ROS_DISTRO ROS_LOCALHOST_ONLY ROS_STATIC_PEERS
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

.PHONY: help setup demo test lint msgs clean
.DEFAULT_GOAL := help

help:
	@echo 'make demo    set up, find grasps on a replayed depth-camera bag, select one and draw them'
	@echo 'make test    set up, check style and types, run all tests; ARGS="test/core -k coder" for some of them'
	@echo 'make setup   make or update .venv; PYTHON=/usr/bin/python3.11 chooses the Python'
	@echo 'make lint    set up, check style and types'
	@echo 'make msgs    set up, build regnet_msgs into .venv again'
	@echo 'make clean   remove .venv, builds and caches'

setup:
	@tools/setup.sh

demo: setup
	$(PY) -m regnet_ros.demo $(ARGS)

test:
	@tools/setup.sh --complete
ifeq ($(strip $(ARGS)),)
	@$(PY) tools/run_tests.py
else
	@$(MAKE) --no-print-directory lint-only
	$(PY) -m pytest $(ARGS)
endif

lint: setup lint-only

.PHONY: lint-only
lint-only:
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

msgs:
	@tools/setup.sh --rebuild-messages

clean:
	rm -rf .venv build install log .mypy_cache .pytest_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
