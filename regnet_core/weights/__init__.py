"""The trained networks: NAME.safetensors with a model card NAME.md, and SHA256SUMS, by which what is loaded is checked.

A folder of one's own, named by the environment variable REGNET_WEIGHTS, is searched first and in the same way.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from regnet_core.errors import ModelError

SUFFIX = ".safetensors"
OWN_FOLDER = "REGNET_WEIGHTS"
"""Environment variable with the path of a folder of further networks."""
CHECKSUMS = "SHA256SUMS"
"""Lines as of sha256sum; files that it does not list are not checked."""
_PUBLISHED = Path(__file__).parent


class WeightsFile(NamedTuple):
    """A file of weights."""

    path: Path
    sha256: str | None = None
    """What the file's must be, where it is known."""


def network_names() -> tuple[str, ...]:
    """The networks that have weights here, in alphabetical order."""
    return tuple(sorted({path.stem for folder in _folders() for path in folder.glob(f"*{SUFFIX}")}))


def weights_file(name: str) -> WeightsFile:
    """The weights of a network.

    Raises:
        ModelError: there are none.
    """
    path = _find(name, SUFFIX)
    return WeightsFile(path, _checksums(path.parent).get(path.name))


def model_card(name: str) -> str:
    """What a network was trained on, what it reaches and where it fails: the text of its card, in Markdown.

    Raises:
        ModelError: there is no card.
    """
    return _find(name, ".md").read_text(encoding="utf-8")


def _folders() -> list[Path]:
    own = os.environ.get(OWN_FOLDER)
    return [Path(own).expanduser(), _PUBLISHED] if own else [_PUBLISHED]


def _find(name: str, suffix: str) -> Path:
    for folder in _folders():
        path = folder / f"{name}{suffix}"
        if path.is_file():
            return path
    places = " or ".join(f"'{folder}'" for folder in _folders())
    there = ", ".join(network_names()) or "none"
    raise ModelError(f"there is no '{name}{suffix}' in {places}; the networks with weights are: {there}")


def _checksums(folder: Path) -> dict[str, str]:
    """File name: sha256."""
    listing = folder / CHECKSUMS
    lines = listing.read_text(encoding="utf-8").splitlines() if listing.is_file() else []
    pairs = (line.split(maxsplit=1) for line in lines if line.strip())
    return {name.lstrip("*"): digest for digest, name in pairs}
