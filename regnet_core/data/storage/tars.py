"""Tar archives whose bytes depend on their members only, and a reader that fetches single members."""

from __future__ import annotations

import io
import os
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from regnet_core.errors import InvalidInputError

_BLOCK = 512
_TEMPORARY = ".unfinished"


class Extent(NamedTuple):
    """Where a member's bytes lie in its archive."""

    offset: int
    size: int


def write_tar(members: Iterable[tuple[str, bytes]]) -> bytes:
    """An archive of these members, in their order, without times or owners."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in members:
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            entry.mode = 0o644
            tar.addfile(entry, io.BytesIO(data))
    return out.getvalue()


def read_tar(data: bytes, what: str) -> list[tuple[str, bytes]]:
    """The members of an archive.

    Raises:
        InvalidInputError: it is damaged; ``what`` names it in the message.
    """
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as tar:
            return [(entry.name, tar.extractfile(entry).read()) for entry in tar]  # type: ignore[union-attr]
    except (tarfile.TarError, EOFError, AttributeError) as error:
        raise InvalidInputError(f"{what} is not a whole tar archive: {error}") from error


def index_tar(path: Path) -> Mapping[str, Extent]:
    """Where each member of an archive lies, without reading the members.

    Raises:
        InvalidInputError: it is damaged or cut short.
    """
    try:
        with tarfile.open(path, mode="r:") as tar:
            extents = {entry.name: Extent(entry.offset_data, entry.size) for entry in tar}
    except (tarfile.TarError, EOFError) as error:
        raise InvalidInputError(f"'{path}' is not a whole tar archive: {error}") from error
    end = max((extent.offset + extent.size for extent in extents.values()), default=0)
    if path.stat().st_size < end + _BLOCK:
        raise InvalidInputError(f"'{path}' is cut short: its members need {end} bytes and it has {path.stat().st_size}")
    return extents


def shard_paths(folder: Path) -> list[Path]:
    """The archives of a data set, in the order of their scenes."""
    return sorted((folder / "shards").glob("shard-*.tar"))


def remove_leftovers(*folders: Path) -> None:
    """Delete what a ``write_whole`` that was killed left behind."""
    for folder in folders:
        for path in folder.glob(f".*{_TEMPORARY}"):
            path.unlink()


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that whoever looks, even after a crash, sees all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}{_TEMPORARY}")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)  # a full disk would stay full
        raise
