"""Renders a scene into a depth camera by ray casting (Open3D)."""

from dataclasses import dataclass

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from regnet_core.data.camera import Camera
from regnet_core.data.noise import DepthNoise, add_depth_noise
from regnet_core.data.scenes import TABLE_COLOUR, Scene
from regnet_core.geometry import transform_points

TABLE_ID = -1
FLOOR_ID = -2
NOTHING_ID = -3
"""What a pixel shows when it is not an object, whose ids are 0, 1, 2 ..."""
FLOOR_COLOUR = (120, 122, 126)


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees, as images of H rows and W columns.

    Attributes:
        camera: where it was seen from.
        depth: (H, W) z in the optical frame [m]; NaN where there is no return.
        normals: (H, W, 3) true unit surface normals in the world, towards the camera; zero where a ray hit nothing.
        object_ids: (H, W) index into the scene's objects, or TABLE_ID, FLOOR_ID, NOTHING_ID.
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


class SceneRenderer:
    """Ray-casting structure of one scene, to be rendered from any number of cameras."""

    def __init__(self, scene: Scene, floor: bool = True) -> None:
        """Args: the scene, and whether there is a floor at z = 0."""
        meshes = [*scene.world_meshes(), scene.table_mesh()]
        ids = [*range(len(scene.objects)), TABLE_ID]
        colours = [*(model.colour for model in scene.objects), TABLE_COLOUR]
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

    def render(self, camera: Camera, noise: DepthNoise | None = None, rng: np.random.Generator | None = None) -> View:
        """Renders one image.

        Args:
            camera: pose and intrinsics.
            noise: None for exact depths.
            rng: source of the noise's random numbers; needed with `noise`.

        Raises:
            ValueError: noise without a generator.
        """
        if noise is not None and rng is None:
            raise ValueError("noise needs a numpy Generator: the same generator state gives the same image")
        intrinsics = camera.intrinsics
        pixels = intrinsics.pixels()
        if noise is not None and rng is not None:
            pixels = pixels + noise.lateral * rng.standard_normal(pixels.shape)
        rays = intrinsics.rays(pixels) @ camera.T_world_camera[:3, :3].T  # (H, W, 3), one unit of t is one metre of z
        depth, normals, geometry = self._cast(camera.position, rays)
        facing = -np.einsum("hwi,hwi->hw", rays, normals) / np.linalg.norm(rays, axis=-1)
        normals = np.where(facing[..., None] < 0.0, -normals, normals)
        facing = np.abs(facing)
        if noise is not None and rng is not None:
            depth = add_depth_noise(depth, np.arccos(np.clip(facing, 0.0, 1.0)), noise, rng)
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
