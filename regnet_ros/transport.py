"""How the nodes' messages travel: with room for a cloud in shared memory, unless the user has chosen something."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from regnet_ros.share import config_file

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
_CHOICES = (PROFILE, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")
"""Variables by which users of Fast DDS choose transports."""
_OWN = "DEFAULT_FASTRTPS_PROFILES.xml"
"""Fast DDS reads a file of this name in the working folder."""
_SHARED_MEMORY, _ROOM = Path("/dev/shm"), 128 << 20
"""Where it is, and how much of it must be free: containers often have 64 MB in all [bytes]."""


def make_room_for_clouds() -> None:
    """Have Fast DDS read ``config/fastdds_nodes.xml`` in this process; to be called before ``rclpy.init``.

    Nothing changes where the user has chosen a transport, where there is little shared memory, or with another
    middleware, which does not read the variable.
    """
    if any(os.environ.get(name) for name in _CHOICES) or Path(_OWN).exists():
        return
    file = config_file("fastdds_nodes.xml")
    try:
        enough = shutil.disk_usage(_SHARED_MEMORY).free >= _ROOM
    except OSError:
        return
    if enough and file.exists():
        os.environ[PROFILE] = str(file)
