"""The places of a cell's objects in a file, so that a cell that is made again goes on where the last one was."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np

from regnet_core.errors import InvalidInputError
from regnet_core.robots.cell import CellConfig, WorkCell


def save_state(cell: WorkCell, path: Path | str) -> None:
    """Write the places of the objects (.npz), all at once: whoever is interrupted leaves the last state or this one."""
    target = Path(path)
    new = target.with_name(f"{target.stem}.{os.getpid()}.new.npz")
    np.savez(new, poses=cell.poses(), made_of=_made_of(cell.config))
    new.replace(target)


def restore_state(cell: WorkCell, path: Path | str) -> bool:
    """Put the objects where `save_state` found them; whether there is such a file.

    Raises:
        InvalidInputError: the file is none of `save_state`, or that of a cell with other objects.
    """
    file = Path(path)
    if not file.is_file():
        return False
    try:
        with np.load(file, allow_pickle=False) as data:
            poses, made_of = data["poses"], data["made_of"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidInputError(f"'{file}' holds no state of a cell: {error}") from error
    if made_of.shape != _made_of(cell.config).shape or not (made_of == _made_of(cell.config)).all():
        raise InvalidInputError(f"'{file}' is the state of a cell with other objects; remove it to begin anew")
    cell.restore(poses)
    return True


def _made_of(config: CellConfig) -> np.ndarray:
    """The numbers that decide which objects there are."""
    return np.array([config.objects, config.seed, config.gripper.width], float)
