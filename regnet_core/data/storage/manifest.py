"""The manifest of a data set: what it was made from, and the checksum of each of its files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from regnet_core import __version__
from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.storage.records import SCHEMA
from regnet_core.data.storage.tars import write_whole
from regnet_core.errors import InvalidInputError

NAME = "manifest.json"
_LIBRARIES = ("numpy", "scipy", "mujoco", "open3d-cpu", "coacd", "manifold3d", "trimesh")
"""What the numbers may depend on."""


@dataclass
class Manifest:
    """Attributes:
    settings: what the data set is made from.
    objects: names of the objects, in the library's order.
    shards: sha256 of each tar file, by name.
    complete: all scenes are there.
    made_with: versions of regnet and of the libraries that its numbers may depend on.
    """

    settings: GenerationSettings
    objects: tuple[str, ...] = ()
    shards: dict[str, str] = field(default_factory=dict)
    complete: bool = False
    made_with: Mapping[str, str] = field(default_factory=lambda: library_versions())

    def save(self, folder: Path) -> None:
        """Writes manifest.json, whole or not at all."""
        document = {
            "schema": SCHEMA,
            "complete": self.complete,
            "settings": self.settings.to_dict(),
            "made_with": dict(self.made_with),
            "shards": dict(sorted(self.shards.items())),
            "objects": self.objects,
        }
        write_whole(folder / NAME, (json.dumps(document, indent=1) + "\n").encode())

    @classmethod
    def load(cls, folder: Path) -> Manifest:
        """Reads manifest.json.

        Raises:
            InvalidInputError: there is none, it is damaged, or it is of another schema.
        """
        path = folder / NAME
        if not path.is_file():
            raise InvalidInputError(f"'{folder}' is no data set: it has no {NAME}; `regnet generate` makes one")
        try:
            document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if document["schema"] != SCHEMA:
                raise InvalidInputError(
                    f"'{path}' has the schema {document['schema']!r}; this version reads {SCHEMA!r}"
                )
            return cls(
                GenerationSettings.from_dict(document["settings"]),
                tuple(document["objects"]),
                dict(document["shards"]),
                bool(document["complete"]),
                dict(document["made_with"]),
            )
        except InvalidInputError:
            raise
        except (ValueError, KeyError, TypeError) as error:
            raise InvalidInputError(f"'{path}' is damaged: {error!r}") from error


def library_versions() -> dict[str, str]:
    """Version of regnet and of each library that a data set's numbers may depend on."""
    found = {"regnet_ros": __version__}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def checksum(path: Path) -> str:
    """sha256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
