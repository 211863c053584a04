"""Makes a data set in a folder; started again after any interruption, it goes on where it was.

    DIR/manifest.json              settings, versions, checksums
    DIR/objects/NAME.safetensors   meshes, convex parts, mass, friction
    DIR/candidates/NAME.st.zst     each object's own grasps; of use for making more scenes only
    DIR/parts/NNNNNN.tar           finished scenes that wait for the rest of their shard
    DIR/shards/shard-NNNNN.tar     finished scenes

Every file is written under another name and then renamed, so that a killed run leaves whole files only. The bytes of a
scene depend on the settings and its number, so neither the number of workers nor an interruption changes a checksum.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from regnet_core.data.generation.executors import Executor
from regnet_core.data.generation.making import make_scene_tar
from regnet_core.data.generation.prepared import (
    FolderSource,
    MemorySource,
    ObjectSource,
    PreparedLibrary,
    candidates_to_bytes,
)
from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.objects.files import object_from_bytes, object_to_bytes
from regnet_core.data.objects.library import ObjectSpec, build_object, library_specs
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.storage.manifest import NAME, Manifest, checksum, library_versions
from regnet_core.data.storage.records import scene_key
from regnet_core.data.storage.tars import index_tar, read_tar, remove_leftovers, write_tar, write_whole
from regnet_core.errors import InvalidInputError

LOCK = ".lock"
Progress = Callable[[str, int, int], None]
"""Called with the stage ("objects" or "scenes"), how many are done, and how many there are."""


def generate(
    folder: Path,
    settings: GenerationSettings,
    executor: Executor,
    *,
    models: Sequence[ObjectModel] = (),
    progress: Progress = lambda stage, done, total: None,
) -> Manifest:
    """Make the data set, or what is missing of it.

    A script that calls this with a ``LocalExecutor`` needs the line ``if __name__ == "__main__":``, since its workers
    are started anew and import it.

    Args:
        folder: where it is made; new, empty, or begun with the same settings (with more scenes it is continued).
        settings: what to make.
        executor: where the work is done.
        models: the user's own objects, whose digest is ``settings.meshes``; none for the procedural library.
        progress: called after every object and scene.

    Raises:
        InvalidInputError: the folder holds something else, or another run is at work in it.
        GenerationError: a scene does not come to rest however often it is drawn.
    """
    with _alone_in(folder):
        return _generate(folder, settings, executor, models, progress)


def _generate(
    folder: Path,
    settings: GenerationSettings,
    executor: Executor,
    models: Sequence[ObjectModel],
    progress: Progress,
) -> Manifest:
    manifest = _open(folder, settings)
    source = FolderSource(folder)
    store = SceneStore(folder, settings, manifest)
    missing = store.missing()
    if missing:
        _prepare(folder, manifest, models, executor, progress)
        names = tuple(manifest.objects)
        shared: ObjectSource = source if executor.local else MemorySource.of(source, names)
        job = SceneJob(settings, names, shared, library_versions())
        progress("scenes", settings.scenes - len(missing), settings.scenes)
        for done, (index, data) in enumerate(executor.run(run_scene_job, job, missing), 1):
            store.add(index, data)
            progress("scenes", settings.scenes - len(missing) + done, settings.scenes)
    manifest.complete = True
    manifest.save(folder)
    return manifest


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep other runs out of the folder; the system lifts the lock of a run that is killed."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / LOCK, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InvalidInputError(f"another run of `regnet generate` is at work in '{folder}'") from None
        yield


def _open(folder: Path, settings: GenerationSettings) -> Manifest:
    remove_leftovers(folder)
    if not (folder / NAME).is_file():
        if any(path.name != LOCK for path in folder.iterdir()):
            raise InvalidInputError(f"'{folder}' holds other files and no {NAME}; choose a new or empty folder")
        manifest = Manifest(settings)
        manifest.save(folder)
        return manifest
    old = Manifest.load(folder)
    if (begun := dataclasses.replace(old.settings, scenes=settings.scenes)) != settings:
        changed = [
            f"{f.name}: {getattr(begun, f.name)!r} there, {getattr(settings, f.name)!r} asked for"
            for f in dataclasses.fields(settings)
            if getattr(begun, f.name) != getattr(settings, f.name)
        ]
        raise InvalidInputError(
            f"'{folder}' was begun with other settings ({'; '.join(changed)}); give the same ones or another folder"
        )
    if old.settings.scenes > settings.scenes:
        raise InvalidInputError(
            f"'{folder}' is a data set of {old.settings.scenes} scenes; it can get more, not fewer ({settings.scenes})"
        )
    if old.made_with != (now := library_versions()):
        changed = [f"{name}: {old.made_with.get(name)} there, {now[name]} here" for name in now
                   if old.made_with.get(name) != now[name]]  # fmt: skip
        raise InvalidInputError(
            f"'{folder}' was begun with other versions ({'; '.join(changed)}), whose scenes would be others; install "
            "those, or choose another folder"
        )
    return Manifest(settings, old.objects, old.shards, False, old.made_with)


# -- objects


@dataclass(frozen=True)
class ObjectJob:
    """What object tasks share."""

    settings: GenerationSettings


ObjectItem = ObjectSpec | bytes
"""A procedural object to build, or the file of one that is built already."""


def run_object_job(job: ObjectJob, item: ObjectItem) -> tuple[str, bytes, bytes]:
    """Name, file and candidates' file of an object."""
    model = object_from_bytes(item) if isinstance(item, bytes) else build_object(item)
    return model.name, object_to_bytes(model), candidates_to_bytes(model, job.settings)


def _prepare(
    folder: Path,
    manifest: Manifest,
    models: Sequence[ObjectModel],
    executor: Executor,
    progress: Progress,
) -> None:
    """Build the objects that are missing, and record all of them in the library's order.

    Raises:
        InvalidInputError: an object's file is not the one that scenes were made with.
    """
    settings = manifest.settings
    source = FolderSource(folder)
    remove_leftovers(folder / "objects", folder / "candidates")
    items: dict[str, ObjectItem]
    if models:
        items = {model.name: object_to_bytes(model) for model in models}
    else:
        items = {spec.name: spec for spec in library_specs(settings.split, settings.objects, settings.seed)}
    missing = [
        item
        for name, item in items.items()
        if not (source.candidates_path(name).is_file() and source.object_path(name).is_file())
    ]
    done = len(items) - len(missing)
    progress("objects", done, len(items))
    for _, (name, model, candidates) in executor.run(run_object_job, ObjectJob(settings), missing):
        recorded = manifest.objects.get(name)
        if recorded not in (None, hashlib.sha256(model).hexdigest()):
            raise InvalidInputError(f"the object {name} is not the one that the scenes in '{folder}' were made with")
        write_whole(source.object_path(name), model)
        write_whole(source.candidates_path(name), candidates)
        done += 1
        progress("objects", done, len(items))
    manifest.objects = {name: checksum(source.object_path(name)) for name in items}
    manifest.save(folder)


# -- scenes


@dataclass(frozen=True, eq=False)
class SceneJob:
    """What scene tasks share."""

    settings: GenerationSettings
    names: tuple[str, ...]
    source: ObjectSource
    versions: Mapping[str, str]


_libraries: dict[tuple[str, str], PreparedLibrary] = {}
"""In a worker: the objects used so far, for every data set it works at."""


def run_scene_job(job: SceneJob, index: int) -> bytes:
    """The tar archive of one scene.

    Raises:
        InvalidInputError: this process has other versions of the libraries than the one that gave the job.
    """
    if (own := library_versions()) != job.versions:
        raise InvalidInputError(f"{socket.gethostname()} has other versions ({own}) than asked for ({job.versions})")
    key = (job.settings.object_digest(), repr(job.source) if isinstance(job.source, FolderSource) else "")
    if key not in _libraries:
        _libraries.clear()
        _libraries[key] = PreparedLibrary(job.source, len(job.settings.widths))
    return make_scene_tar(index, job.settings, job.names, _libraries[key])


class SceneStore:
    """The finished scenes of a folder: parts, and shards as soon as all their scenes are there."""

    def __init__(self, folder: Path, settings: GenerationSettings, manifest: Manifest) -> None:
        self.parts = folder / "parts"
        self.shards = folder / "shards"
        self._folder = folder
        self._settings = settings
        self._manifest = manifest
        self._recover()

    def missing(self) -> list[int]:
        """Numbers of the scenes that are neither in a shard nor a part."""
        there = {index for shard in range(self._count()) if self._path(shard).is_file() for index in self._range(shard)}
        there |= {int(path.stem) for path in self.parts.glob("[0-9]*.tar")}
        return [index for index in range(self._settings.scenes) if index not in there]

    def add(self, index: int, data: bytes) -> None:
        """Store a scene, and its shard if it was the last one."""
        write_whole(self._part(index), data)
        self._close(index // self._settings.shard_size)

    def _recover(self) -> None:
        """Bring an earlier run's folder into order: leftovers go, shards that should have more scenes are opened."""
        remove_leftovers(self.parts, self.shards)
        for shard in range(self._count()):
            if self._path(shard).is_file():
                self._reopen(shard)
            self._close(shard)

    def _reopen(self, shard: int) -> None:
        """Back to parts, if the shard holds fewer scenes than it should by now."""
        path = self._path(shard)
        there = {name.split(".", 1)[0] for name in index_tar(path)}
        if there == {scene_key(index) for index in self._range(shard)}:
            if path.name not in self._manifest.shards:
                self._record(shard)
            for index in self._range(shard):
                self._part(index).unlink(missing_ok=True)
            return
        for key, members in _by_scene(read_tar(path.read_bytes(), f"'{path}'")).items():
            write_whole(self.parts / f"{key}.tar", write_tar(members))
        self._forget(shard)
        path.unlink()

    def _close(self, shard: int) -> None:
        """Make the shard, if all its scenes are there as parts."""
        parts = [self._part(index) for index in self._range(shard)]
        if not parts or not all(part.is_file() for part in parts):
            return
        self._forget(shard)
        members = [member for part in parts for member in read_tar(part.read_bytes(), f"'{part}'")]
        write_whole(self._path(shard), write_tar(members))
        self._record(shard)
        for part in parts:
            part.unlink()

    def _forget(self, shard: int) -> None:
        """Take the checksum out of the manifest before the file changes: a missing one is made up for, a wrong not."""
        if self._manifest.shards.pop(self._path(shard).name, None) is not None:
            self._manifest.save(self._folder)

    def _record(self, shard: int) -> None:
        path = self._path(shard)
        self._manifest.shards[path.name] = checksum(path)
        self._manifest.save(self._folder)

    def _count(self) -> int:
        return -(-self._settings.scenes // self._settings.shard_size)

    def _range(self, shard: int) -> range:
        size = self._settings.shard_size
        return range(shard * size, min((shard + 1) * size, self._settings.scenes))

    def _path(self, shard: int) -> Path:
        return self.shards / f"shard-{shard:05d}.tar"

    def _part(self, index: int) -> Path:
        return self.parts / f"{scene_key(index)}.tar"


def _by_scene(members: Sequence[tuple[str, bytes]]) -> dict[str, list[tuple[str, bytes]]]:
    scenes: dict[str, list[tuple[str, bytes]]] = {}
    for name, data in members:
        scenes.setdefault(name.split(".", 1)[0], []).append((name, data))
    return scenes
