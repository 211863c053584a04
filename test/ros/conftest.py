"""Fixtures for real nodes: a ROS domain of its own for every module, and processes that end with the module."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator, Iterator

import pytest

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)

from live import System, reserved_domain


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """A ROS domain of the module's own; every process that is started in it is killed at the end."""
    with reserved_domain() as domain:
        created = System(domain, tmp_path_factory.mktemp("logs"))
        yield created
        created.close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What the node processes wrote, beside the failure of a test that talked to them."""
    report = yield
    system = getattr(item, "funcargs", {}).get("system")
    if report.failed and isinstance(system, System):
        report.sections += [(f"output of {name}", text) for name, text in system.outputs().items()]
    return report
