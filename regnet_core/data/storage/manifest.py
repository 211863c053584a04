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
from regnet_core.data.storage.tars import shard_paths, write_whole
from regnet_core.errors import InvalidInputError

NAME = "manifest.json"
GENERATOR = "1"
"""To be counted up with every change that makes other scenes, views or labels of the same settings."""
_LIBRARIES = ("numpy", "scipy", "mujoco", "open3d-cpu", "coacd", "manifold3d", "trimesh")
"""What the numbers may depend on."""


@dataclass
class Manifest:
    """Attributes:
    settings: what the data set is made from.
    objects: sha256 of each object's file, by name, in the library's order.
    shards: sha256 of each tar file, by name.
    complete: all scenes are there.
    made_with: versions of regnet and of the libraries that its numbers may depend on.
    """

    settings: GenerationSettings
    objects: dict[str, str] = field(default_factory=dict)
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
                dict(document["objects"]),
                dict(document["shards"]),
                bool(document["complete"]),
                dict(document["made_with"]),
            )
        except InvalidInputError:
            raise
        except (ValueError, KeyError, TypeError) as error:
            raise InvalidInputError(f"'{path}' is damaged: {error!r}") from error


def library_versions() -> dict[str, str]:
    """Version of the generator, of regnet and of each library that a data set's numbers may depend on."""
    found = {"generator": GENERATOR, "regnet_ros": __version__}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def damaged_files(folder: Path) -> list[str]:
    """Files of a data set that are missing or do not have the checksum of the manifest, relative to its folder.

    Raises:
        InvalidInputError: there is no manifest, or it is damaged.
    """
    manifest = Manifest.load(folder)
    expected = {f"shards/{name}": digest for name, digest in manifest.shards.items()}
    expected |= {f"objects/{name}.safetensors": digest for name, digest in manifest.objects.items()}
    wrong = {name for name, digest in expected.items() if not matches(folder / name, digest)}
    unknown = {f"shards/{path.name}" for path in shard_paths(folder)} - set(expected)
    return sorted(wrong | unknown)


def matches(path: Path, digest: str) -> bool:
    """Whether a file is there and has the checksum."""
    return path.is_file() and checksum(path) == digest


def checksum(path: Path) -> str:
    """sha256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
