"""Renders a scene into a depth camera by ray casting (Open3D)."""

from dataclasses import dataclass

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from regnet_core.data.cameras.camera import Camera, Window
from regnet_core.data.cameras.colour_noise import ColourNoise, add_colour_noise
from regnet_core.data.cameras.noise import DepthNoise, lateral_offsets, noisy_depth
from regnet_core.data.scenes.scene import TABLE_COLOUR, Scene
from regnet_core.geometry import Box, transform_points

TABLE_ID = -1
FLOOR_ID = -2
NOTHING_ID = -3
FIXTURE_ID = -4
"""What a pixel shows when it is not an object, whose ids are 0, 1, 2 ..."""
FLOOR_COLOUR = (120, 122, 126)
FIXTURE_COLOUR = (92, 108, 128)


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees, as images of H rows and W columns.

    Attributes:
        camera: where it was seen from.
        depth: (H, W) z in the optical frame [m]; NaN where there is no return.
        normals: (H, W, 3) true unit surface normals in the world, towards the camera; zero where a ray hit nothing.
        object_ids: (H, W) index into the scene's objects, or TABLE_ID, FLOOR_ID, FIXTURE_ID, NOTHING_ID.
        colours: (H, W, 3) uint8 red, green, blue.
    """

    camera: Camera
    depth: NDArray[np.float64]
    normals: NDArray[np.float64]
    object_ids: NDArray[np.int64]
    colours: NDArray[np.uint8]

    def points(self) -> NDArray[np.float64]:
        """(H, W, 3) organised points in the optical frame [m]; NaN where there is no return."""
        intrinsics = self.camera.intrinsics
        return intrinsics.rays(intrinsics.pixels()) * self.depth[..., None]

    def world_points(self) -> NDArray[np.float64]:
        """(H, W, 3) the same points in the world frame."""
        flat = transform_points(self.camera.T_world_camera, self.points().reshape(-1, 3))
        return flat.reshape(*self.depth.shape, 3)

    def cloud(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """(N, 3) points in the world of the pixels with a return, and (N,) those pixels' indices in a flat image.

        Quicker than `world_points` where most of the image has no return: `colours.reshape(-1, 3)[index]` are the
        points' colours, and so on.
        """
        index = np.flatnonzero(np.isfinite(self.depth))
        width = self.camera.intrinsics.width
        rays = self.camera.intrinsics.rays(np.stack([index % width, index // width], axis=-1).astype(np.float64))
        points = rays * self.depth.ravel()[index, None]
        # Not a matrix product: for so many short rows its threads cost ten times as much on a busy machine.
        return np.einsum("ni,ji->nj", points, self.camera.T_world_camera[:3, :3]) + self.camera.position, index


class SceneRenderer:
    """Ray-casting structure of one scene, to be rendered from any number of cameras."""

    def __init__(self, scene: Scene, floor: bool = True, table_colour: tuple[int, int, int] = TABLE_COLOUR) -> None:
        """Args: the scene, whether there is a floor at z = 0, and the table's red, green and blue in 0..255."""
        fixtures = scene.fixture_meshes()
        meshes = [*scene.world_meshes(), scene.table_mesh(), *fixtures]
        ids = [*range(len(scene.objects)), TABLE_ID, *(FIXTURE_ID for _ in fixtures)]
        colours = [*(model.colour for model in scene.objects), table_colour, *(FIXTURE_COLOUR for _ in fixtures)]
        if floor:
            meshes.append(trimesh.creation.box(bounds=[[-4.0, -4.0, -0.1], [4.0, 4.0, 0.0]]))
            ids.append(FLOOR_ID)
            colours.append(FLOOR_COLOUR)
        self._caster = o3d.t.geometry.RaycastingScene()
        for mesh in meshes:
            self._caster.add_triangles(
                o3d.core.Tensor(np.ascontiguousarray(mesh.vertices, dtype=np.float32)),
                o3d.core.Tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)),
            )
        self._ids = np.array([*ids, NOTHING_ID], dtype=np.int64)
        self._colours = np.array([*colours, (0, 0, 0)], dtype=np.float64)

    def render(
        self,
        camera: Camera,
        noise: DepthNoise | None = None,
        rng: np.random.Generator | None = None,
        *,
        region: Box | None = None,
        colour_noise: ColourNoise | None = None,
    ) -> View:
        """Renders one image.

        Args:
            camera: pose and intrinsics.
            noise: None for exact depths.
            rng: source of the noise's random numbers; needed with `noise` and `colour_noise`.
            region: only what lies in this box of the world is wanted. Rays are cast only through the part of the image
                that shows the box, so noise differs from that of the whole image; pixels whose point, as measured, is
                outside have no return and show NOTHING_ID.
            colour_noise: None for the surfaces' shaded colours.

        Raises:
            ValueError: noise without a generator.
        """
        if (noise is not None or colour_noise is not None) and rng is None:
            raise ValueError("noise needs a numpy Generator: the same generator state gives the same image")
        window = None if region is None else camera.window(region, margin=1 if noise is None else noise.reach)
        if region is None or window is None:
            view = self._render(camera, noise, rng)
        elif window.width * window.height == 0:
            view = _blank(camera)
        else:
            part = self._render(Camera(camera.intrinsics.cropped(window), camera.T_world_camera), noise, rng)
            view = _only_inside(part, region, camera, window)
        if colour_noise is not None and rng is not None:
            shown = view.object_ids != NOTHING_ID
            view.colours[shown] = add_colour_noise(view.colours[shown], colour_noise, rng)
        return view

    def _render(self, camera: Camera, noise: DepthNoise | None, rng: np.random.Generator | None) -> View:
        intrinsics = camera.intrinsics
        pixels = intrinsics.pixels()
        if noise is not None and rng is not None:
            pixels = pixels + lateral_offsets((intrinsics.height, intrinsics.width), noise, rng)
        rays = intrinsics.rays(pixels) @ camera.T_world_camera[:3, :3].T  # (H, W, 3), one unit of t is one metre of z
        depth, normals, geometry = self._cast(camera.position, rays)
        facing = -np.einsum("hwi,hwi->hw", rays, normals) / np.linalg.norm(rays, axis=-1)
        normals = np.where(facing[..., None] < 0.0, -normals, normals)
        facing = np.abs(facing)
        if noise is not None and rng is not None:
            noisy = noisy_depth(depth, np.arccos(np.clip(facing, 0.0, 1.0)), noise, rng)
            depth = noisy.depth
            # What shows a surface's depth shows that surface.
            for image in (geometry.reshape(-1), facing.reshape(-1), normals.reshape(-1, 3)):
                image[noisy.bled] = image[noisy.source]
        shade = 0.55 + 0.3 * facing + 0.15 * np.clip(normals[..., 2], 0.0, 1.0)
        colours = np.clip(np.round(self._colours[geometry] * shade[..., None]), 0, 255).astype(np.uint8)
        return View(camera, depth, normals, self._ids[geometry], colours)

    def _cast(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Distance (H, W) in units of the directions, normal (H, W, 3), index of the mesh (H, W; -1 for nothing)."""
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=-1).astype(np.float32)
        hit = self._caster.cast_rays(o3d.core.Tensor(rays))
        distance = hit["t_hit"].numpy().astype(np.float64)
        nothing = ~np.isfinite(distance)
        distance[nothing] = np.nan
        normals = hit["primitive_normals"].numpy().astype(np.float64)
        normals[nothing] = 0.0
        return distance, normals, np.where(nothing, -1, hit["geometry_ids"].numpy().astype(np.int64))


def _blank(camera: Camera) -> View:
    """A view of nothing."""
    shape = (camera.intrinsics.height, camera.intrinsics.width)
    return View(
        camera,
        depth=np.full(shape, np.nan),
        normals=np.zeros((*shape, 3)),
        object_ids=np.full(shape, NOTHING_ID, dtype=np.int64),
        colours=np.zeros((*shape, 3), dtype=np.uint8),
    )


def _only_inside(part: View, region: Box, camera: Camera, window: Window) -> View:
    """The whole image that has `part` in its window, as far as the points of `part` are in the region."""
    points, index = part.cloud()
    inside = np.zeros(part.depth.shape, dtype=bool)
    inside.flat[index[region.contains(points)]] = True
    view = _blank(camera)
    np.copyto(view.depth[window.slices], part.depth, where=inside)
    np.copyto(view.object_ids[window.slices], part.object_ids, where=inside)
    np.copyto(view.normals[window.slices], part.normals, where=inside[..., None])
    np.copyto(view.colours[window.slices], part.colours, where=inside[..., None])
    return view
