"""A tiny data set that the tests of evaluation share."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from regnet_core.data.generation.run import generate
from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.labels.candidates import CandidateConfig
from regnet_core.data.storage.archive import SceneArchive


class Here:
    """Runs everything in this process, forwards or backwards."""

    local = True
    workers = 1

    def __init__(self, backwards: bool = False) -> None:
        self.backwards = backwards

    def run(self, function: Any, shared: Any, items: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
        for item in reversed(items) if self.backwards else items:
            yield item, function(shared, item)


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenes with two views each, and labels for two widths."""
    folder = tmp_path_factory.mktemp("tiny") / "data"
    settings = GenerationSettings(
        seed=4,
        split="test",
        scenes=3,
        widths=(0.06, 0.10),
        kinds=(("packed", 1.0), ("bin", 1.0)),
        paper_views=1,
        dome_views=1,
        objects=5,
        shard_size=2,
        candidates=CandidateConfig(points=120),
    )
    generate(folder, settings, Here())
    return folder


@pytest.fixture
def tiny(tiny_folder: Path) -> SceneArchive:
    return SceneArchive(tiny_folder)


@pytest.fixture
def here() -> Here:
    return Here()


@pytest.fixture
def backwards() -> Here:
    return Here(backwards=True)
