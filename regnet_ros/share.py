"""Files that are installed with the package."""

from __future__ import annotations

import sys
from pathlib import Path


def config_file(name: str) -> Path:
    """A file of the folder config where it is installed."""
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        share = Path(get_package_share_directory("regnet_ros"))
    except (PackageNotFoundError, LookupError):  # AMENT_PREFIX_PATH is not set, as in a plain virtual environment
        share = Path(sys.prefix) / "share" / "regnet_ros"
    return share / "config" / name
