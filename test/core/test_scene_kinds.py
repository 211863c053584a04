"""Scenes of every kind: at rest, free of overlaps, where they belong, and the same again from the same seed."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core.data.objects.models import ObjectModel, build_mesh
from regnet_core.data.scenes.bins import BinConfig, make_bin, sample_bin
from regnet_core.data.scenes.dropping import DropConfig
from regnet_core.data.scenes.kinds import SCENE_KINDS, KindConfig, SceneError, compose_scene, object_count
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.data.scenes.settling import Settling
from regnet_core.data.scenes.standing import PackConfig, pack, stands
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.sim.world import world_spec


def _model(name: str, family: str, **params: float) -> ObjectModel:
    return ObjectModel(name, family, params, build_mesh(family, params), (180, 40, 40), 600.0, 0.6)


MODELS = (
    _model("tall", "box", x=0.03, y=0.04, z=0.15),
    _model("flat", "box", x=0.06, y=0.1, z=0.03),
    _model("tin", "can", radius=0.03, height=0.1, chamfer=0.004),
    _model("rod", "cylinder", radius=0.012, height=0.12),
    _model("jar", "cylinder", radius=0.033, height=0.08),
    _model("cube", "box", x=0.05, y=0.05, z=0.05),
)
PEBBLE = _model("pebble", "superquadric", x=0.02, y=0.03, z=0.05, e1=1.0, e2=1.0)


def _compose(kind: str, seed: int = 0) -> Scene:
    return compose_scene(kind, MODELS[:1] if kind == "single" else MODELS, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {kind: _compose(kind) for kind in SCENE_KINDS}


def _settling(scene: Scene) -> Settling:
    """The scene back in physics, as it is."""
    physics = Settling(scene.objects, scene.table, scene.fixtures)
    for k, pose in enumerate(scene.poses):
        physics.place(k, Rotation.from_matrix(pose[:3, :3]), pose[:3, 3])
    return physics


@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_scenes_stay_as_they_are(scenes: dict[str, Scene], kind: str) -> None:
    physics = _settling(scenes[kind])
    assert physics.penetration() < 0.001
    physics.step(0.5)
    np.testing.assert_allclose(physics.poses()[:, :3, 3], scenes[kind].poses[:, :3, 3], atol=0.002)


@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_nothing_is_below_or_beside_the_table(scenes: dict[str, Scene], kind: str) -> None:
    scene = scenes[kind]
    assert min(mesh.bounds[0][2] for mesh in scene.world_meshes()) > scene.table_height - 0.001
    assert np.all(np.abs(scene.poses[:, :2, 3]) < 0.38)
    assert bool(scene.fixtures) == (kind == "bin")


@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_the_same_seed_gives_the_same_scene(scenes: dict[str, Scene], kind: str) -> None:
    np.testing.assert_array_equal(_compose(kind).poses, scenes[kind].poses)
    assert not np.allclose(_compose(kind, seed=1).poses, scenes[kind].poses)


def test_packed_things_stand_side_by_side() -> None:
    for seed in range(5):
        scene = _compose("packed", seed)
        np.testing.assert_allclose(scene.poses[:, 2, 2], 1.0, atol=1e-4)
        assert np.ptp(Rotation.from_matrix(scene.poses[:, :3, :3]).as_euler("zyx")[:, 0]) > 0.5, "turned at random"
        outlines = [mesh.vertices[:, :2] for mesh in scene.world_meshes()]
        nearest = []
        for k, outline in enumerate(outlines[1:], 1):
            nearest.append(min(_gap(outline, other) for other in outlines[:k]))
        assert min(nearest) > 0.008 and max(nearest) < 0.042


def _gap(a: np.ndarray, b: np.ndarray) -> float:
    """Distance between the convex hulls of two sets of points in the plane [m]: the widest separating strip."""
    angle = np.linspace(0.0, 2.0 * np.pi, 720)
    axes = np.stack([np.cos(angle), np.sin(angle)])
    return float(((a @ axes).min(axis=0) - (b @ axes).max(axis=0)).max())


def test_what_would_roll_over_lies_on_its_side() -> None:
    assert all(stands(model.mesh) for model in MODELS) and not stands(PEBBLE.mesh)
    scene = pack([PEBBLE], np.random.default_rng(0))
    assert abs(scene.poses[0, 2, 0]) > 0.98, "its shortest axis, x, is up"
    thin = build_mesh("cylinder", {"radius": 0.005, "height": 0.2})
    assert not stands(thin), "it would fall over when touched"


def test_everything_is_inside_the_bin() -> None:
    for seed in range(3):
        scene = _compose("bin", seed)
        lower = np.min([box.lower for box in scene.fixtures], axis=0)
        upper = np.max([box.upper for box in scene.fixtures], axis=0)
        assert lower[2] == scene.table_height and 0.09 <= upper[2] - lower[2] <= 0.16
        sides = np.sort((upper - lower)[:2]) - 0.02
        assert 0.25 <= sides[0] <= 0.35 <= sides[1] <= 0.45
        assert np.all((scene.poses[:, :2, 3] > lower[:2] + 0.01) & (scene.poses[:, :2, 3] < upper[:2] - 0.01))
        assert min(mesh.bounds[0][2] for mesh in scene.world_meshes()) > lower[2] + 0.009, "on the bin's floor"


def test_a_bin_is_closed_at_its_sides_and_open_above() -> None:
    made = make_bin(np.array([-0.2, -0.1]), np.array([0.2, 0.1]), ground=0.75, height=0.1, wall=0.01)
    assert made.inside.lower == pytest.approx((-0.2, -0.1, 0.76))
    assert made.inside.upper == pytest.approx((0.2, 0.1, 0.86))
    around = np.array(
        [[0.0, 0.0, 0.755], [-0.205, 0.05, 0.8], [0.205, -0.05, 0.8], [0.1, -0.105, 0.8], [0, 0.105, 0.8]]
    )
    assert [int(np.flatnonzero([box.contains(p[None])[0] for box in made.boxes])[0]) for p in around] == [0, 1, 2, 3, 4]
    assert not any(box.contains([[0.0, 0.0, 0.8], [0.0, 0.0, 0.87]]).any() for box in made.boxes)
    lengthwise = {np.argmax(np.subtract(*_ends(seed))[:2]) for seed in range(8)}
    assert lengthwise == {0, 1}, "along x or y"


def _ends(seed: int) -> tuple[np.ndarray, np.ndarray]:
    inside = sample_bin(np.random.default_rng(seed), default_table()).inside
    return np.array(inside.upper), np.array(inside.lower)


def test_a_bin_that_is_too_small_is_an_error_that_names_the_kind() -> None:
    tiny = BinConfig(length=(0.02, 0.02), width=(0.02, 0.02), height=(0.01, 0.01))
    config = KindConfig(drop=DropConfig(redrops=1, attempts=2), bin=tiny)
    with pytest.raises(SceneError, match=r"kind 'bin' with 6 objects: 6 objects did not come to rest in the bin in 2"):
        compose_scene("bin", MODELS, np.random.default_rng(0), config=config)


def test_a_pack_that_falls_over_is_an_error_that_names_the_kind() -> None:
    config = KindConfig(pack=PackConfig(margin=0.49, attempts=2))
    with pytest.raises(SceneError, match="kind 'packed' with 6 objects: 6 objects did not come to rest side by side"):
        compose_scene("packed", MODELS, np.random.default_rng(0), config=config)


def test_single_things_stand_or_lie() -> None:
    upright = [_compose("single", seed).poses[0, 2, 2] > 0.999 for seed in range(12)]
    assert 2 <= sum(upright) <= 10


def test_counts_are_those_of_the_kinds() -> None:
    rng = np.random.default_rng(0)
    for kind, low, high in (("single", 1, 1), ("pile", 5, 20), ("packed", 4, 10), ("bin", 5, 15)):
        counts = {object_count(kind, rng) for _ in range(400)}
        assert (min(counts), max(counts)) == (low, high)


def test_what_cannot_be_composed_is_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(InvalidInputError, match="no scene kind 'shelf'; there are pile, single, packed, bin"):
        compose_scene("shelf", MODELS, rng)
    with pytest.raises(InvalidInputError, match="no scene kind 'shelf'"):
        object_count("shelf", rng)
    with pytest.raises(InvalidInputError, match="takes 1 model, got 6"):
        compose_scene("single", MODELS, rng)
    with pytest.raises(InvalidInputError, match="unique names"):
        compose_scene("pile", [MODELS[0], MODELS[0]], rng)
    with pytest.raises(InvalidInputError, match="unique names, got \\[\\]"):
        compose_scene("packed", [], rng)
    with pytest.raises(InvalidInputError, match=r"gap is .least, largest."):
        PackConfig(gap=(0.04, 0.01))


def test_the_walls_of_a_bin_are_obstacles_to_the_judge() -> None:
    table = default_table()
    made = make_bin(np.array([-0.2, -0.15]), np.array([0.2, 0.15]), ground=0.75, height=0.1, wall=0.01)
    cube = MODELS[5].mesh.copy().apply_translation([0.0, 0.12, 0.785])
    down = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # approach -z, closing +y
    # Around the cube, whose side is 5 mm from the wall at y = 0.15; and around the wall itself.
    grasps = Grasps(
        np.tile(down, (2, 1, 1)),
        np.array([[0.0, 0.12, 0.83], [-0.1, 0.155, 0.87]]),
        np.full(2, 0.08),
        np.ones(2),
        np.ones(2),
        np.ones(2),
    )
    gripper = Gripper(width=0.08)
    free, walled = GroundTruth([cube], table), GroundTruth([cube], table, made.boxes)
    assert free.collides(grasps, gripper).tolist() == [False, False]
    assert walled.collides(grasps, gripper).tolist() == [True, False]
    assert free.antipodal(grasps, gripper).score == pytest.approx([1.0, 0.0])
    assert walled.antipodal(grasps, gripper).object_index.tolist() == [-1, -1], "a pad meets the wall first"
    only = GroundTruth([], None, made.boxes)
    assert only.collides(grasps[:1], gripper).tolist() == [True]


def test_the_physics_knows_the_fixtures() -> None:
    made = make_bin(np.array([-0.2, -0.15]), np.array([0.2, 0.15]), ground=0.75, height=0.1, wall=0.01)
    assert world_spec(MODELS[:1], default_table(), made.boxes).compile().ngeom == 1 + 5 + 1
