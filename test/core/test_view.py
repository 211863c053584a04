"""Pictures: projection, rasterising, what is drawn, and the self-contained page."""

import dataclasses
import json
import math
import re
import time
from html.parser import HTMLParser

import numpy as np
import pytest
import shapes
from PIL import Image

from regnet_core import GraspDetector, Grasps, Gripper, InvalidInputError, Plane
from regnet_core.view import RenderStyle, ViewScene, render_panels, render_png, write_html
from regnet_core.view.camera import clearest_azimuth, framing_camera
from regnet_core.view.meshes import approach_arrow, fork_mesh, gripper_mesh
from regnet_core.view.palette import SELECTED, TABLE, height_colors, rank_colors
from regnet_core.view.raster import Layer, draw_mesh, draw_points
from regnet_core.view.render import prepare_views
from regnet_core.view.scene import spread_out
from regnet_core.view.shadows import shadow_of

SIZE = (240, 180)
TABLE_PLANE = Plane((0.0, 0.0, 1.0), shapes.TABLE)


def small_scene(**changes: object) -> ViewScene:
    points = shapes.single_view(shapes.box(0.05, 0.12, 0.10))
    grasps = Grasps.from_poses(
        np.stack([[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]] * 3),
        [[0.0, -0.05, 0.88], [0.0, 0.0, 0.88], [0.0, 0.05, 0.88]],
        [0.06] * 3,
        [0.9, 0.8, 0.7],
    )
    scene = ViewScene(points, None, grasps, Gripper(), 1, TABLE_PLANE, "a box", "three grasps")
    return dataclasses.replace(scene, **changes)


# Cameras


@pytest.mark.parametrize("elevation", [0.2, 0.7, 1.4])
@pytest.mark.parametrize("azimuth", [-2.0, 0.0, 1.0, 3.0])
def test_the_camera_frames_all_points_as_large_as_they_fit(elevation, azimuth):
    points = np.random.default_rng(0).normal(size=(200, 3)) * [0.3, 0.1, 0.05] + [1.0, -2.0, 0.75]
    pixels, depth = framing_camera(points, SIZE, elevation, azimuth).project(points)
    share = 2 * np.abs(pixels / SIZE - 0.5).max(axis=0)
    assert (depth > 0).all()
    assert share.max() == pytest.approx(0.9, abs=1e-6)


def test_up_is_up_and_the_right_hand_side_is_on_the_right():
    camera = framing_camera(np.array([[0.0, 0, 0], [0.1, 0.1, 0.1]]), SIZE, math.radians(40), -math.pi / 2)
    (middle, above, right), _ = camera.project(np.array([[0.0, 0, 0], [0, 0, 0.1], [0.1, 0, 0]]))
    assert above[1] < middle[1] and right[0] > middle[0]
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.rotation) == pytest.approx(1.0)


def test_the_clearest_view_is_from_where_the_camera_was():
    points = shapes.single_view(shapes.box(0.12, 0.12, 0.20))
    target = np.array([0.0, 0.0, shapes.TABLE + 0.1])
    azimuth = clearest_azimuth(points, target, math.radians(40))
    truth = math.atan2(shapes.CAMERA[1], shapes.CAMERA[0])
    assert abs(math.remainder(azimuth - truth, 2 * math.pi)) < math.radians(31)
    assert clearest_azimuth(points, target, 0.7, (0.0, 5.0, 1.0)) == pytest.approx(math.pi / 2)


# Meshes and rasterising


@pytest.mark.parametrize("opening", [None, 0.03])
def test_the_gripper_mesh_is_closed_and_has_the_volume_of_the_bodies(opening):
    gripper = Gripper()
    mesh = gripper_mesh(gripper, opening)
    corners = mesh.vertices[mesh.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    expected = sum(np.prod(np.subtract(box.upper, box.lower)) for box in gripper.bodies(opening))
    assert volume == pytest.approx(expected)  # positive: the faces turn anticlockwise seen from outside


def test_the_fork_keeps_the_opening_free_and_the_arrow_ends_behind_the_hand():
    gripper = Gripper()
    fork = fork_mesh(gripper, 0.05).vertices
    assert np.abs(fork[fork[:, 0] > 0.01][:, 1]).min() == pytest.approx(0.025)
    assert fork[:, 0].max() == pytest.approx(gripper.depth)
    arrow = approach_arrow(gripper, length=0.08).vertices
    assert arrow[:, 0].max() <= -gripper.palm_depth
    assert np.ptp(arrow[:, 0]) == pytest.approx(0.08)


def test_the_nearer_of_two_things_is_seen_whatever_the_order():
    light = np.array([0.0, 0.0, 1.0])
    camera = framing_camera(np.array([[-0.1, -0.1, 0], [0.1, 0.1, 0.1]]), SIZE, math.radians(80), 0.0)
    low, high = (gripper_mesh(Gripper()).transformed(pose) for pose in (lifted(0.0), lifted(0.1)))
    pictures = []
    for order in ((low, high), (high, low)):
        layer = Layer.empty(SIZE)
        for mesh in order:
            draw_mesh(layer, camera, mesh, np.float32([1, 0, 0] if mesh is high else [0, 1, 0]), light)
        pictures.append(layer)
    np.testing.assert_array_equal(pictures[0].color, pictures[1].color)
    (centre,), (depth,) = camera.project(np.array([[-0.03, 0.0, 0.105]]))
    column, row = centre.astype(int)
    assert pictures[0].depth[row, column] == pytest.approx(depth, abs=0.002)
    assert pictures[0].color[row, column, 0] > 0.5 and pictures[0].color[row, column, 1] == 0


def lifted(height: float) -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = height
    return pose


def test_discs_fill_a_plane_with_its_colour_and_depth():
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.1, 0.1, 60), [0.0]), -1).reshape(-1, 3)
    camera = framing_camera(grid, SIZE, math.radians(50), 0.3)
    up = np.tile([0.0, 0.0, 1.0], (len(grid), 1))
    color = np.tile(np.float32([0.2, 0.4, 0.6]), (len(grid), 1))
    layer = draw_points(camera, grid, up, color, np.full(len(grid), 0.008))
    pixels, depth = camera.project(grid)
    inner = np.abs(grid[:, :2]).max(axis=1) < 0.09
    column, row = pixels[inner].astype(int).T
    np.testing.assert_allclose(layer.color[row, column], color[inner], atol=1e-5)
    np.testing.assert_allclose(layer.depth[row, column], depth[inner], atol=0.001)
    covered = np.isfinite(layer.depth)
    for line in (covered[SIZE[1] // 2], covered[:, SIZE[0] // 2]):
        hit = np.flatnonzero(line)
        assert len(hit) == hit[-1] - hit[0] + 1 > 80  # no holes


def test_points_behind_the_camera_and_an_empty_cloud_draw_nothing():
    camera = framing_camera(np.array([[-0.1, -0.1, 0], [0.1, 0.1, 0.1]]), SIZE, 0.7, 0.0)
    behind = camera.position[None] + 0.5 * (camera.position - np.array([0, 0, 0.05]))[None]
    for points in (behind, np.zeros((0, 3))):
        layer = draw_points(camera, points, points, np.ones((len(points), 3), np.float32), np.full(len(points), 0.01))
        assert np.isinf(layer.depth).all()


def test_the_shadow_lies_below_the_hand():
    hand = gripper_mesh(Gripper()).transformed(lifted(0.2))
    touching = [-0.03, 0.0, 0.2]
    points = np.array([[-0.03, 0.0, 0.0], [-0.03, 0.3, 0.0], [-0.03, 0.0, 0.4], touching])
    np.testing.assert_array_equal(shadow_of(hand, points, np.array([0.0, 0.0, 1.0])), [1.0, 0.0, 0.0, 0.0])


# What is chosen


def test_grasps_that_are_drawn_are_the_best_of_their_spot():
    rotation = np.tile(np.eye(3), (5, 1, 1))
    grasps = Grasps.from_poses(
        rotation, [[0, 0, 0], [0.01, 0, 0], [0.2, 0, 0], [0.21, 0, 0], [0.5, 0, 0]], [0.05] * 5, [0.5] * 5
    )
    assert spread_out(grasps, Gripper(), 10).tolist() == [0, 2, 4]
    assert spread_out(grasps, Gripper(), 2).tolist() == [0, 2]
    assert spread_out(Grasps.empty(), Gripper(), 2).tolist() == []


def test_the_selected_grasp_is_drawn_once_and_only_the_surroundings_are():
    far = np.array([[5.0, 5.0, shapes.TABLE], [0.0, 0.0, 0.0]])
    scene = small_scene()
    (view,) = prepare_views(
        [dataclasses.replace(scene, points=np.concatenate([scene.points, far]))], SIZE, RenderStyle()
    )
    assert view.ranks.tolist() == [0, 2]
    assert 0 < len(view.scene.points) < len(scene.points)
    assert np.abs(view.scene.points[:, :2]).max() < 0.3


def test_ranks_go_from_green_to_red_and_the_table_is_grey():
    colors = rank_colors(5)
    assert colors[0].argmax() == 1 and colors[-1].argmax() == 0
    assert (np.diff(colors[:, 1]) < 0.15).all() and len(rank_colors(1)) == 1 and len(rank_colors(0)) == 0
    points = np.array([[0, 0, shapes.TABLE], [0, 0, shapes.TABLE + 0.05], [0, 0, shapes.TABLE + 0.1]])
    shown = height_colors(points, TABLE_PLANE)
    np.testing.assert_array_equal(shown[0], TABLE)
    assert not np.allclose(shown[1], shown[2], atol=0.1)


# Whole pictures


def blue_share(picture: np.ndarray) -> float:
    """Share of the pixels that have the hue of the selected grasp."""
    red, green, blue = picture.astype(float).transpose(2, 0, 1)
    ratio = SELECTED / SELECTED.max()
    like = (blue > 60) & (np.abs(red / np.maximum(blue, 1) - ratio[0]) < 0.12)
    return float((like & (np.abs(green / np.maximum(blue, 1) - ratio[1]) < 0.12)).mean())


def test_the_picture_shows_the_object_and_the_selected_grasp():
    plain = RenderStyle(azimuth=0.5)
    with_hand = render_panels(small_scene(), panel_size=SIZE, style=plain)[64:-46]
    without = render_panels(small_scene(selected=None), panel_size=SIZE, style=plain)[64:-46]
    assert with_hand.shape == (SIZE[1], SIZE[0] + 20, 3)
    assert blue_share(with_hand) > 0.02 > 0.001 > blue_share(without)
    assert len(np.unique(with_hand.reshape(-1, 3), axis=0)) > 1000


def test_colours_of_the_cloud_are_used():
    red = np.tile(np.uint8([200, 0, 0]), (len(small_scene().points), 1))
    scene = small_scene(colors=red, grasps=Grasps.empty(), selected=None)
    picture = render_panels(scene, panel_size=SIZE)[64:-46].astype(int)
    assert ((picture[..., 0] > 100) & (picture[..., 1:].max(axis=-1) < 20)).mean() > 0.2


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.full((5, 3), np.nan), np.array([[0.0, 0.0, 0.8]]), np.zeros((40, 3))]
)
def test_clouds_with_nothing_to_see_give_a_picture_and_a_page(points, tmp_path):
    scene = ViewScene(points, None, Grasps.empty(), Gripper(), title="nothing", caption="the cloud is empty")
    assert render_panels(scene, panel_size=SIZE).std() > 1  # the title is there
    write_html(tmp_path / "page.html", scene)
    assert "the cloud is empty" in (tmp_path / "page.html").read_text()


def test_panels_are_side_by_side_and_the_same_scene_looks_the_same_twice(tmp_path):
    one = render_panels(small_scene(), panel_size=SIZE)
    scenes = [small_scene(), small_scene(grasps=Grasps.empty(), selected=None)]
    render_png(tmp_path / "two.png", scenes, panel_size=SIZE)
    two = np.asarray(Image.open(tmp_path / "two.png"))
    assert two.shape == (one.shape[0], 2 * SIZE[0] + 30, 3)
    np.testing.assert_array_equal(two[64:-46, 10 : 10 + SIZE[0]], one[64:-46, 10 : 10 + SIZE[0]])


def test_a_picture_of_a_real_detection_takes_less_than_five_seconds_of_computing():
    points = shapes.single_view(shapes.box(0.05, 0.12, 0.10))
    detection = GraspDetector("antipodal").detect(points)
    scene = ViewScene.of_detection(detection, points, selected=0)
    start = time.process_time()  # unlike the clock on the wall, it does not count what else the machine does
    picture = render_panels([scene, scene])
    assert time.process_time() - start < 5.0
    assert picture.std() > 20


@pytest.mark.parametrize(("write", "name"), [(render_png, "a.jpg"), (write_html, "a.htm")])
def test_wrong_suffixes_and_no_scene_are_refused(write, name, tmp_path):
    with pytest.raises(InvalidInputError, match=name):
        write(tmp_path / name, small_scene())
    with pytest.raises(InvalidInputError, match="no scene"):
        write(tmp_path / ("a.png" if name == "a.jpg" else "a.html"), [])


# The page


class References(HTMLParser):
    """Collects what a page would load."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.loaded += [value for name, value in attrs if name in ("src", "href", "data", "srcset") and value]


def traces_of(page: str) -> list[dict]:
    """The traces that the page hands to plotly."""
    start = page.index("[", re.search(r"Plotly\.newPlot\(\s*\"[^\"]+\",", page).end())
    return json.JSONDecoder().raw_decode(page[start:])[0]


def test_the_page_needs_no_network_and_switches_between_scenes(tmp_path):
    scene = small_scene(title="first <one>")
    other = dataclasses.replace(scene, title="second", grasps=scene.grasps[:1], selected=None)
    write_html(tmp_path / "page.html", [scene, other], title="Grasps & more")
    page = (tmp_path / "page.html").read_text()
    parser = References()
    parser.feed(page)
    assert parser.loaded == []
    assert "<title>Grasps &amp; more</title>" in page and len(page) > 1_000_000
    traces = traces_of(page)
    names = [trace["name"] for trace in traces]
    assert names[0].startswith("cloud (") and sum(name.startswith("cloud") for name in names) == 1
    assert "selected (rank 1)" in names and "approach from the pre-grasp" in names
    hover = next(t for t in traces if t["name"] == "ranks 0 to 2")["text"]
    assert "rank 0<br>quality 0.900" in hover[0] and "opening 60 mm" in hover[0]
    assert [t.get("visible") for t in traces if t["name"] == "best of each spot"] == [True, False]
    assert "second" in page


def test_a_page_of_a_large_cloud_is_thinned(tmp_path):
    points = np.random.default_rng(0).random((200_000, 3))
    write_html(tmp_path / "page.html", ViewScene(points, None, Grasps.empty(), Gripper()))
    name = traces_of((tmp_path / "page.html").read_text())[0]["name"]
    assert name == "cloud (60000 of 200000 points)"
