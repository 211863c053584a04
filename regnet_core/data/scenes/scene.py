"""A scene: objects at rest on a table, and its file."""

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from regnet_core.data.objects.models import ObjectModel
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box

TABLE_HEIGHT = 0.75
"""Height of the table's top above the floor, z = 0 [m]."""
TABLE_COLOUR = (196, 164, 128)
_TABLE_NODE = "table"
_FIXTURE_NODE = "fixture_"


def default_table(height: float = TABLE_HEIGHT, side: float = 1.0, thickness: float = 0.05) -> Box:
    """A square table top centred over the world's origin [m]."""
    half = 0.5 * side
    return Box((-half, -half, height - thickness), (half, half, height))


@dataclass(frozen=True, eq=False)
class Scene:
    """Objects on a table, in a gravity-aligned world frame (z up, metres, the floor at z = 0).

    Attributes:
        objects: K models; none on an empty table.
        poses: (K, 4, 4) T_world_object.
        table: the table top.
        fixtures: other boxes that never move, such as the floor and the walls of a bin.
    """

    objects: tuple[ObjectModel, ...]
    poses: NDArray[np.float64]
    table: Box
    fixtures: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.objects), 4, 4):
            raise InvalidInputError(
                f"poses of {len(self.objects)} objects have shape (K, 4, 4), got {self.poses.shape}"
            )
        names = [model.name for model in self.objects]
        reserved = [name for name in names if name == _TABLE_NODE or name.startswith(_FIXTURE_NODE)]
        if len(set(names)) != len(names) or reserved:
            raise InvalidInputError(
                f"object names are unique and none is {_TABLE_NODE!r} or starts with {_FIXTURE_NODE!r}, got {names}"
            )

    @property
    def table_height(self) -> float:
        """Height of the table's top [m]."""
        return float(self.table.upper[2])

    def world_meshes(self) -> list[trimesh.Trimesh]:
        """A copy of each object's mesh in the world frame, in the order of `objects`."""
        return [model.mesh.copy().apply_transform(pose) for model, pose in zip(self.objects, self.poses, strict=True)]

    def table_mesh(self) -> trimesh.Trimesh:
        """The table top as a mesh in the world frame."""
        return trimesh.creation.box(bounds=(self.table.lower, self.table.upper))

    def fixture_meshes(self) -> list[trimesh.Trimesh]:
        """The fixtures as meshes in the world frame."""
        return [trimesh.creation.box(bounds=(box.lower, box.upper)) for box in self.fixtures]

    def save(self, path: Path | str) -> None:
        """Writes a binary glTF file (.glb): one named node per object, its pose as the node's matrix.

        The file keeps the world frame as it is, z up. Family, parameters, density, friction and colour travel in each
        mesh's `extras`, so that `load` restores the same scene.
        """
        out = trimesh.Scene()
        for model, pose in zip(self.objects, self.poses, strict=True):
            extras = {
                "family": model.family,
                "params": dict(model.params),
                "density": model.density,
                "friction": model.friction,
                "colour": list(model.colour),
            }
            mesh = _for_export(model.mesh, model.colour, extras)
            out.add_geometry(mesh, node_name=model.name, geom_name=model.name, transform=pose)
        statics = [(_TABLE_NODE, self.table), *((f"{_FIXTURE_NODE}{i}", box) for i, box in enumerate(self.fixtures))]
        for name, box in statics:
            mesh = _for_export(trimesh.creation.box(bounds=(box.lower, box.upper)), TABLE_COLOUR, {})
            out.add_geometry(mesh, node_name=name, geom_name=name)
        Path(path).write_bytes(out.export(file_type="glb"))

    @classmethod
    def load(cls, path: Path | str) -> "Scene":
        """Reads what `save` wrote.

        Raises:
            InvalidInputError: the file has no node named "table", or an object lacks the extras that `save` writes.
        """
        loaded = trimesh.load_scene(str(path), process=False)
        nodes = {str(node): _node(loaded, node) for node in loaded.graph.nodes_geometry}
        if _TABLE_NODE not in nodes:
            raise InvalidInputError(f"{path} has no node named {_TABLE_NODE!r}; its nodes are {sorted(nodes)}")
        statics = [_TABLE_NODE, *sorted((n for n in nodes if n.startswith(_FIXTURE_NODE)), key=lambda n: (len(n), n))]
        table, *fixtures = (_box(*nodes.pop(name), loaded) for name in statics)
        names = sorted(nodes)
        objects = [_model(name, loaded.geometry[nodes[name][1]], path) for name in names]
        poses = np.array([nodes[name][0] for name in names], dtype=np.float64).reshape(-1, 4, 4)
        return cls(tuple(objects), poses, table, tuple(fixtures))


def _node(loaded: trimesh.Scene, node: Hashable) -> tuple[NDArray[np.float64], str]:
    """The pose (4, 4) of a node and the name of its geometry."""
    pose, geometry = loaded.graph[node]
    return pose, str(geometry)


def _box(pose: NDArray[np.float64], geometry: str, loaded: trimesh.Scene) -> Box:
    mesh = loaded.geometry[geometry].copy().apply_transform(pose)
    # The file holds single-precision vertices; a micrometre is finer than any table.
    lower, upper = np.round(np.asarray(mesh.bounds, dtype=np.float64), 6).tolist()
    return Box(tuple(lower), tuple(upper))


def _for_export(mesh: trimesh.Trimesh, colour: tuple[int, int, int], extras: dict[str, object]) -> trimesh.Trimesh:
    """A copy without cached normals (a viewer computes flat ones) and with a plain material."""
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[*colour, 255], metallicFactor=0.0, roughnessFactor=0.8
    )
    visual = trimesh.visual.TextureVisuals(material=material)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, metadata=extras, visual=visual)


def _model(name: str, mesh: trimesh.Trimesh, path: Path | str) -> ObjectModel:
    extras = mesh.metadata
    missing = {"family", "params", "density", "friction", "colour"} - set(extras)
    if missing:
        raise InvalidInputError(f"object {name!r} of {path} lacks {sorted(missing)} in its extras")
    return ObjectModel(
        name=name,
        family=str(extras["family"]),
        params={key: float(value) for key, value in extras["params"].items()},
        mesh=trimesh.Trimesh(mesh.vertices, mesh.faces, process=False),
        colour=(int(extras["colour"][0]), int(extras["colour"][1]), int(extras["colour"][2])),
        density=float(extras["density"]),
        friction=float(extras["friction"]),
    )
