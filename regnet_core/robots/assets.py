"""The robots' MuJoCo models. They come with the package robosuite (MIT licence), of which only these files are used.

robosuite is found without importing it: what it needs to run, it does not need to be read.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from regnet_core.errors import ModelError

_FOLDER = Path("models", "assets", "robots")
HOW_TO_INSTALL = "pip install --no-deps robosuite==1.5.2"
"""Without its dependencies: it pins an old release of mink and brings packages for cameras and keyboards."""


def robot_file(name: str) -> Path:
    """The file of a robot's model, such as ``baxter/robot.xml``.

    Raises:
        ModelError: robosuite is not installed, or this version of it lacks the file.
    """
    found = importlib.util.find_spec("robosuite")
    if found is None or not found.submodule_search_locations:
        raise ModelError(f"the models of the robots are part of robosuite, which is not installed: {HOW_TO_INSTALL}")
    path = Path(next(iter(found.submodule_search_locations))) / _FOLDER / name
    if not path.is_file():
        raise ModelError(f"the installed robosuite has no {_FOLDER / name}; one that has it: {HOW_TO_INSTALL}")
    return path
