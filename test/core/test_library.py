"""The object library: splits that are apart, files that hold an object exactly."""

import itertools
import json

import mujoco
import numpy as np
import pytest
import trimesh
from safetensors.numpy import load, save

from regnet_core.data.objects.files import object_from_bytes, object_to_bytes
from regnet_core.data.objects.library import (
    BANDS,
    DEFAULT_COUNTS,
    HEAVIEST,
    SPLITS,
    TRAIN_GAP,
    ObjectSpec,
    build_object,
    library_specs,
    normalised,
    split_families,
)
from regnet_core.data.objects.models import FAMILIES, ObjectModel
from regnet_core.data.scenes.scene import default_table
from regnet_core.errors import InvalidInputError
from regnet_core.sim.world import world_spec


def _leading(spec: ObjectSpec) -> np.ndarray:
    """(2,) the first two parameters, normalised."""
    return np.array(list(normalised(spec.family, dict(spec.params)).values())[:2])


def _by_family(split: str, seeds: int) -> dict[str, np.ndarray]:
    """(N, 2) leading parameters of each family's objects over many libraries."""
    drawn: dict[str, list[np.ndarray]] = {}
    for seed in range(seeds):
        for spec in library_specs(split, 400, seed):
            drawn.setdefault(spec.family, []).append(_leading(spec))
    return {family: np.array(points) for family, points in drawn.items()}


def test_any_two_splits_are_apart_whatever_the_seed() -> None:
    drawn = {split: _by_family(split, seeds=5) for split in SPLITS}
    for first, second in itertools.combinations(SPLITS, 2):
        gap = TRAIN_GAP if first == "train" else 0.04
        for family in split_families("train"):
            a, b = drawn[first][family], drawn[second][family]
            nearest = np.abs(a[:, None] - b[None]).sum(axis=2).min()
            assert nearest >= gap - 1e-9, (first, second, family)
            assert nearest < gap + 0.1, "the bound is reached, so the rule is no stricter than it says"


def test_every_split_covers_the_range_of_every_parameter() -> None:
    for split in SPLITS:
        for family, points in _by_family(split, seeds=5).items():
            assert points.min() < 0.15 and points.max() > 0.85, (split, family)


def test_the_bands_are_as_far_apart_as_they_say() -> None:
    ends = [*BANDS["train"], *BANDS["val"], *BANDS["test"], 1.0 + BANDS["train"][0]]
    assert ends == sorted(ends)
    assert min(BANDS["val"][0] - BANDS["train"][1], 1.0 - BANDS["test"][1]) == pytest.approx(TRAIN_GAP)


def test_some_families_occur_in_the_test_split_alone() -> None:
    families = {split: {spec.family for spec in library_specs(split, 200)} for split in SPLITS}
    assert families["train"] == families["val"]
    assert families["test"] - families["train"] == {name for name, family in FAMILIES.items() if family.held_out}
    assert len(families["test"] - families["train"]) >= 3


@pytest.mark.parametrize("split", SPLITS)
def test_families_are_balanced_and_names_unique(split: str) -> None:
    specs = library_specs(split)
    assert len(specs) == DEFAULT_COUNTS[split]
    counts = [sum(spec.family == family for spec in specs) for family in split_families(split)]
    assert max(counts) - min(counts) <= 1
    assert len({spec.name for spec in specs}) == len(specs)
    assert all(spec.name == f"{split}_{i:04d}_{spec.family}" for i, spec in enumerate(specs))


def test_a_library_depends_on_its_seed_alone_and_only_grows_with_its_count() -> None:
    assert library_specs("val", 90, 3) == library_specs("val", 90, 3)
    assert library_specs("val", 40, 3) == library_specs("val", 90, 3)[:40]
    assert library_specs("val", 40, 3) != library_specs("val", 40, 4)
    assert library_specs("val", 0) == ()


def test_a_spec_is_hashable_and_survives_json() -> None:
    specs = library_specs("test", 60)
    assert len(set(specs)) == 60
    assert tuple(ObjectSpec.from_json(spec.to_json()) for spec in specs) == specs


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"name": "x"}', "no json"])
def test_what_is_no_spec_is_refused(text: str) -> None:
    with pytest.raises(InvalidInputError, match=r"a line that ObjectSpec\.to_json wrote"):
        ObjectSpec.from_json(text)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="no split 'dev' of the object library; there are train, val, test"):
        library_specs("dev")
    with pytest.raises(InvalidInputError, match="is 0 or more, got -1"):
        library_specs("train", -1)


@pytest.fixture(scope="module")
def models() -> list[ObjectModel]:
    """One object of every family at least."""
    return [build_object(spec) for spec in library_specs("test", len(FAMILIES), 1)]


def test_objects_are_closed_light_and_decomposed(models: list[ObjectModel]) -> None:
    for model in models:
        assert model.mesh.is_volume and model.parts, model.name
        assert 0.001 < model.mass <= HEAVIEST * (1.0 + 1e-9), model.name


def test_the_physics_engine_takes_every_object(models: list[ObjectModel]) -> None:
    compiled: mujoco.MjModel = world_spec(models, default_table()).compile()
    assert compiled.ngeom == 1 + sum(len(model.convex_parts) for model in models)


def test_an_object_file_holds_the_object_exactly(models: list[ObjectModel]) -> None:
    for model in models:
        data = object_to_bytes(model)
        assert data == object_to_bytes(model)
        read = object_from_bytes(data)
        assert object_to_bytes(read) == data
        np.testing.assert_array_equal(read.mesh.vertices, model.mesh.vertices)
        np.testing.assert_array_equal(read.mesh.faces, model.mesh.faces)
        assert read.parts is not None and model.parts is not None and len(read.parts) == len(model.parts)
        for part, true in zip(read.parts, model.parts, strict=True):
            np.testing.assert_array_equal(part.vertices, true.vertices)
            np.testing.assert_array_equal(part.faces, true.faces)
        assert (read.name, read.family, dict(read.params)) == (model.name, model.family, dict(model.params))
        assert (read.colour, read.density, read.friction) == (model.colour, model.density, model.friction)


def test_an_object_without_parts_stays_without(models: list[ObjectModel]) -> None:
    model = ObjectModel("bare", "user_mesh", {}, trimesh.creation.box(extents=(0.1, 0.1, 0.1)), (1, 2, 3), 1.0, 0.5)
    assert object_from_bytes(object_to_bytes(model)).parts is None


def test_damaged_and_foreign_bytes_are_refused(models: list[ObjectModel]) -> None:
    data = object_to_bytes(models[0])
    for damaged in (b"", b"x", data[:50], data[:-1], data + b"x", b"PK" + data):
        with pytest.raises(InvalidInputError, match="no safetensors file, or it is damaged"):
            object_from_bytes(damaged)
    with pytest.raises(InvalidInputError, match=r"an object file holds \['faces', 'part_faces'"):
        object_from_bytes(save({"weights": np.zeros(3)}))


def test_no_changed_byte_gives_another_error(models: list[ObjectModel]) -> None:
    data, rng = object_to_bytes(models[0]), np.random.default_rng(0)
    refused, read = 0, 0
    for _ in range(500):
        changed = bytearray(data)
        changed[rng.integers(900)] = rng.integers(256)
        try:
            model = object_from_bytes(bytes(changed))
        except InvalidInputError:
            refused += 1
        else:  # the byte was within a text or a number, or the same as before
            read += 1
            assert model.mesh.faces.shape == models[0].mesh.faces.shape
    assert refused > 50 and read > 5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": "regnet_object/9"}, "reads object files of schema 'regnet_object/1', got 'regnet_object/9'"),
        ({"colour": [1, 2]}, "an object file is damaged"),
        ({"density": "heavy"}, "an object file is damaged"),
    ],
)
def test_wrong_metadata_are_refused(change: dict[str, object], message: str, models: list[ObjectModel]) -> None:
    data = object_to_bytes(models[0])
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    description = json.loads(header["__metadata__"]["object"]) | change
    with pytest.raises(InvalidInputError, match=message):
        object_from_bytes(save(load(data), metadata={"object": json.dumps(description)}))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("vertices", np.full((8, 3), np.nan), "finite vertices"),
        ("vertices", np.zeros((8, 3), np.float32), r"vertices of an object file is \(N, 3\) F64"),
        ("faces", np.full((12, 3), 99, np.int32), "faces that name them"),
        ("part_offsets", np.zeros((2, 2), np.int32), "part_offsets of an object file rise"),
        ("part_offsets", np.zeros((0, 2), np.int32), "part_offsets of an object file rise"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(name: str, value: np.ndarray, message: str) -> None:
    box = next(spec for spec in library_specs("train") if spec.family == "box")
    data = object_to_bytes(build_object(box))
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    with pytest.raises(InvalidInputError, match=message):
        object_from_bytes(save(load(data) | {name: value}, metadata=header["__metadata__"]))
