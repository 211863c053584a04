"""A user's own meshes as objects: read, repaired, checked, decomposed; or refused, with what to do about it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import coacd
import manifold3d
import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from regnet_core.data.objects.convex import SMALLEST_PART, convex_decomposition
from regnet_core.data.objects.library import HEAVIEST
from regnet_core.data.objects.models import ObjectModel
from regnet_core.errors import InvalidInputError

SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
FAMILY = "user_mesh"
"""What `ObjectModel.family` says of an imported object."""
DENSITY = 500.0
"""[kg/m^3], of a half-empty package or of wood; less where the object would be heavier than HEAVIEST."""
FRICTION = 0.6
GREY = (160, 160, 160)
"""Colour of a mesh whose file gives none."""
LARGEST, SMALLEST = 0.6, 0.01
"""Limits of an object's largest extent [m]."""
SMALLEST_VOLUME = 1e-7
"""[m^3]; less is a surface without an inside."""
WIDEST_GRASP = 0.12
"""Opening of the widest gripper, unless another is given [m]."""
MOST_FACES = 20_000
LARGEST_HOLE = 0.1
"""Holes are filled up to this share of the surface; a larger one is more likely an opening than a defect."""
_GENERIC = re.compile(
    r"(non)?textured|visual|collision|mesh(es)?|model|object|scene|tsdf|poisson|google_\d+k|stl|obj|ply|\d{1,2}"
)
"""Names that say nothing of what the object is."""
_SCALES = (0.001, 0.01, 0.0254, 10.0, 100.0, 1000.0)


@dataclass(frozen=True)
class Refusal:
    """A file that is not used.

    Attributes:
        path: the file.
        reason: what is wrong and what would help, in one line.
    """

    path: Path
    reason: str


@dataclass(frozen=True, eq=False)
class ImportResult:
    """What became of a folder.

    Attributes:
        accepted: objects with meshes, parts and unique names, in the order of their files' paths.
        refused: the other files, in the same order.
    """

    accepted: tuple[ObjectModel, ...]
    refused: tuple[Refusal, ...]


class _RefusedError(Exception):
    """Carries the reason of a refusal."""


def import_meshes(folder: Path, scale: float = 1.0, widest: float = WIDEST_GRASP) -> ImportResult:
    """Makes an object of every mesh file (SUFFIXES) in a folder and the folders in it.

    Lengths are metres after scaling. Open seams, small holes, wrong windings, duplicate and degenerate faces are
    repaired, and large meshes simplified. A name comes from the file's name or, where that says nothing, from its
    folder's: `003_cracker_box/google_16k/textured.obj` is `003_cracker_box`.

    Args:
        folder: where the files are.
        scale: metres per unit of the files.
        widest: opening of the widest gripper that is to grasp them [m].

    Raises:
        InvalidInputError: the folder does not exist or holds no mesh files, or the scale is not a positive number.
    """
    if not (np.isfinite(scale) and scale > 0.0):
        raise InvalidInputError(f"the scale of objects is a positive number of metres per unit, got {scale}")
    if not folder.is_dir():
        raise InvalidInputError(f"{folder} is not a folder; give the one that holds your meshes")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    if not paths:
        raise InvalidInputError(f"no mesh files under {folder}; these are read: {', '.join(SUFFIXES)}")
    accepted: dict[str, ObjectModel] = {}
    origins: dict[str, Path] = {}
    refused = []
    for path in paths:
        words = _words(path.relative_to(folder))
        try:
            mesh, colour = _import(path, scale, widest)
            _refuse_copy(
                mesh, [(accepted[name], origin) for name, origin in origins.items() if _same(origin, path, folder)]
            )
            name = _unique(words, accepted)
            accepted[name] = _model(name, mesh, colour)
            origins[name] = path
        except _RefusedError as refusal:
            refused.append(Refusal(path, str(refusal)))
        except Exception as error:  # whatever the libraries that repair and decompose make of a strange mesh
            reason = f"it cannot be repaired: {type(error).__name__}: {str(error)[:120]}"
            refused.append(Refusal(path, f"{reason}; make it watertight in a mesh editor"))
    return ImportResult(tuple(accepted.values()), tuple(refused))


def grasp_width(mesh: trimesh.Trimesh) -> float:
    """An estimate of the smallest opening that can hold a closed mesh [m].

    The smaller of the mesh's width along evenly spread directions, and of the thickness that one in fifty points of
    its surface has at most; a point's thickness counts where both sides face away from each other to within 30 degrees.
    """
    corners = np.asarray(mesh.convex_hull.vertices)
    directions = _directions(400)
    width = float(np.ptp(corners @ directions.T, axis=0).min())
    thickness = _thickness(mesh)
    return min(width, float(np.quantile(thickness, 0.02))) if len(thickness) else width


# Names


def _words(path: Path) -> list[str]:
    """The parts of a path that say what an object is, the most telling one last; one at least."""
    words = [re.sub(r"\W+", "_", part).strip("_") for part in (*path.parts[:-1], path.stem)]
    telling = [word for word in words if word and not _GENERIC.fullmatch(word.lower())]
    return telling or [words[-1] or "object"]


def _unique(words: Sequence[str], taken: dict[str, ObjectModel]) -> str:
    """The last word; with the ones before it, or a number, where that is taken or means something in a scene file."""
    names = ["_".join(words[-k:]) for k in range(1, len(words) + 1)]
    names = [f"object_{name}" if name == "table" or name.startswith("fixture_") else name for name in names]
    numbered = (f"{names[-1]}_{k}" for k in range(2, len(taken) + 3))
    return next(name for name in (*names, *numbered) if name not in taken)


def _same(first: Path, second: Path, folder: Path) -> bool:
    """Whether two files have the same telling words."""
    return _words(first.relative_to(folder)) == _words(second.relative_to(folder))


def _refuse_copy(mesh: trimesh.Trimesh, others: Sequence[tuple[ObjectModel, Path]]) -> None:
    """Data sets such as YCB hold each object in several formats and resolutions."""
    for model, path in others:
        if np.allclose(mesh.extents, model.mesh.extents, rtol=0.02) and np.isclose(
            mesh.volume, model.mesh.volume, rtol=0.05
        ):
            raise _RefusedError(f"it is another copy of {path.name} ({path}), which is used")


# Reading


def _import(path: Path, scale: float, widest: float) -> tuple[trimesh.Trimesh, tuple[int, int, int]]:
    """The closed mesh of a file, centre of mass at the origin, and its colour."""
    pieces = _read(path)
    colour = _colour(pieces)
    vertices = [scale * np.asarray(piece.vertices) for piece in pieces]
    starts = np.cumsum([0, *(len(v) for v in vertices[:-1])])
    faces = [np.asarray(piece.faces) + start for piece, start in zip(pieces, starts, strict=True)]
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    _check_size(mesh, scale)
    mesh = _simplified(_closed(mesh))
    _check_inside(mesh, widest)
    mesh.apply_translation(-mesh.center_mass)
    return mesh, colour


def _read(path: Path) -> list[trimesh.Trimesh]:
    """The file's meshes, in the file's units, where its nodes put them."""
    try:
        scene = trimesh.load_scene(str(path))
        pieces = [item for item in scene.dump() if isinstance(item, trimesh.Trimesh) and len(item.faces)]
    except Exception as error:  # Readers of eight formats raise whatever their libraries do.
        raise _RefusedError(
            f"it cannot be read as {path.suffix}: {type(error).__name__}: {str(error)[:120]}"
        ) from error
    if not pieces:
        raise _RefusedError("it has no faces; a point cloud must be meshed first")
    if not all(np.isfinite(piece.vertices).all() for piece in pieces):
        raise _RefusedError("some of its vertices are not finite numbers; export it again")
    return pieces


def _colour(pieces: Sequence[trimesh.Trimesh]) -> tuple[int, int, int]:
    """The mean colour of the pieces that have one, weighted by area; grey when none has."""
    coloured = [(piece.area, _mean_colour(piece)) for piece in pieces if getattr(piece.visual, "defined", False)]
    total = sum(area for area, _ in coloured)
    if total <= 0.0:
        return GREY
    red, green, blue = (round(sum(area * float(rgb[k]) for area, rgb in coloured) / total) for k in range(3))
    return red, green, blue


def _mean_colour(piece: trimesh.Trimesh) -> NDArray[np.float64]:
    """(3,) mean of the vertices' colours, or of a texture at the vertices."""
    visual = piece.visual
    try:
        plain = visual.to_color() if isinstance(visual, trimesh.visual.TextureVisuals) else visual
        colours = np.asarray(getattr(plain, "vertex_colors", None), dtype=np.float64)
        return colours.reshape(-1, 4)[:, :3].mean(axis=0)
    except Exception:  # A texture that is missing or has no coordinates: the mesh is still good.
        return np.array(GREY, dtype=np.float64)


# Repair


def _closed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh as one closed surface that faces outwards."""
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if not len(mesh.faces):
        raise _RefusedError("all of its faces are degenerate; export it again")
    trimesh.repair.fix_normals(mesh, multibody=True)
    if not mesh.is_watertight:
        mesh = _filled(mesh)
    if mesh.is_volume and mesh.body_count == 1:
        return mesh
    if mesh.is_watertight:
        mesh = _united(mesh)
    if mesh.is_volume:
        return mesh
    if abs(mesh.volume) < SMALLEST_VOLUME and mesh.convex_hull.volume < SMALLEST_VOLUME:
        raise _RefusedError("it is a flat sheet without an inside; give it a thickness")
    return _rebuilt(mesh)


def _filled(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with a fan of triangles over each small hole."""
    centres: list[NDArray[np.float64]] = []
    fans: list[NDArray[np.int64]] = []
    for loop in _boundary_loops(mesh):
        corners = np.asarray(mesh.vertices)[loop]
        centre = corners.mean(axis=0)
        a, b = corners - centre, np.roll(corners, -1, axis=0) - centre
        share = 0.5 * np.linalg.norm(np.cross(a, b), axis=1).sum() / mesh.area
        if share > LARGEST_HOLE:
            raise _RefusedError(
                f"it is not closed: a hole of {1e4 * share * mesh.area:.1f} cm^2 is {share:.0%} of its surface; close "
                "it, or give the shell a thickness, in a mesh editor"
            )
        middle = len(mesh.vertices) + len(centres)
        centres.append(centre)
        fans.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), middle)], axis=1))
    vertices = np.concatenate([mesh.vertices, *(centre[None] for centre in centres)])
    filled = trimesh.Trimesh(vertices, np.concatenate([mesh.faces, *fans]), process=False)
    trimesh.repair.fix_normals(filled, multibody=True)
    return filled


def _boundary_loops(mesh: trimesh.Trimesh) -> list[NDArray[np.int64]]:
    """The vertices around each hole, in the direction of the faces' own edges; holes may touch at vertices."""
    edges = np.asarray(mesh.edges)
    single = trimesh.grouping.group_rows(np.sort(edges, axis=1), require_count=1)
    following: dict[int, list[int]] = {}
    for a, b in edges[single].tolist():
        following.setdefault(a, []).append(b)
    loops = []
    for first in list(following):
        walk = [first]
        while following.get(walk[-1]):
            here = following[walk[-1]].pop()
            if here in walk:
                start = walk.index(here)
                loops.append(np.array(walk[start:]))
                del walk[start + 1 :]
            else:
                walk.append(here)
    return [loop for loop in loops if len(loop) > 2]


def _united(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The union of the bodies of a mesh; the largest one where they do not touch and the others are crumbs."""
    bodies = [body for body in mesh.split(only_watertight=True) if body.is_volume]
    if not bodies:
        return mesh
    united = trimesh.boolean.union(bodies, engine="manifold") if len(bodies) > 1 else bodies[0]
    apart = sorted(united.split(only_watertight=True), key=lambda body: -abs(body.volume))
    if len(apart) > 1 and apart[1].volume > 0.01 * apart[0].volume:
        raise _RefusedError(f"it consists of {len(apart)} pieces that do not touch; give each a file of its own")
    return apart[0] if apart else united


def _rebuilt(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The last resort: the union of the convex parts that CoACD finds after remeshing, if that is the same shape."""
    coacd.set_log_level("error")
    source = coacd.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    parts = coacd.run_coacd(source, threshold=0.04, preprocess_mode="on", seed=0)
    hulls = [trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in parts]
    rebuilt = trimesh.boolean.union([hull for hull in hulls if hull.volume > SMALLEST_PART], engine="manifold")
    points, _ = trimesh.sample.sample_surface(mesh, 2000, seed=0)
    distance = _ray_scene(rebuilt).compute_distance(o3d.core.Tensor(np.asarray(points, dtype=np.float32))).numpy()
    if not rebuilt.is_volume or rebuilt.body_count != 1 or np.quantile(distance, 0.95) > 0.02 * mesh.extents.max():
        raise _RefusedError(
            "it is not a closed surface, and its defects (edges with one face, or more than two) cannot be repaired; "
            "make it watertight in a mesh editor"
        )
    return rebuilt


def _simplified(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with at most about MOST_FACES faces, as far as a hundredth of its size allows."""
    tolerance = float(mesh.extents.max()) / 4000.0
    solid = None
    while len(mesh.faces) > MOST_FACES and tolerance < 0.01 * mesh.extents.max():
        solid = solid or manifold3d.Manifold(
            manifold3d.Mesh64(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.uint64))
        )
        coarse = solid.simplify(tolerance).to_mesh64()
        simple = trimesh.Trimesh(coarse.vert_properties[:, :3], coarse.tri_verts)
        mesh = simple if simple.is_volume and simple.body_count == 1 else mesh
        tolerance *= 2.0
    return mesh


# Checks


def _check_size(mesh: trimesh.Trimesh, scale: float) -> None:
    extent = float(mesh.extents.max())
    if SMALLEST <= extent <= LARGEST:
        return
    fitting = [factor for factor in _SCALES if 0.02 <= factor * extent <= 0.4]
    units = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches"}
    advice = (
        f"; for a file in {units.get(fitting[0], 'other units')} use --objects-scale {scale * fitting[0]:g}"
        if fitting
        else ""
    )
    raise _RefusedError(
        f"its largest extent is {extent:.3g} m, and objects of {SMALLEST} to {LARGEST} m are used; lengths are metres"
        + advice
    )


def _check_inside(mesh: trimesh.Trimesh, widest: float) -> None:
    if mesh.volume < SMALLEST_VOLUME:
        raise _RefusedError(
            f"its volume is {1e6 * mesh.volume:.3g} cm^3, that of a surface without an inside; give it a thickness"
        )
    width = grasp_width(mesh)
    if width > widest:
        raise _RefusedError(
            f"there is nothing to grasp: it is {width:.3f} m thick where it is thinnest, and the widest gripper opens "
            f"{widest:g} m"
        )


def _thickness(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """(N,) how far it is through the mesh at sampled points of its surface whose far side faces away [m]."""
    points, faces = trimesh.sample.sample_surface(mesh, 1500, seed=0)
    normals = mesh.face_normals[faces]
    start = points - 1e-5 * normals
    rays = np.concatenate([start, -normals], axis=1).astype(np.float32)
    hits = _ray_scene(mesh).cast_rays(o3d.core.Tensor(rays))
    distance, other = hits["t_hit"].numpy(), hits["primitive_normals"].numpy()
    opposed = np.abs(np.sum(other * normals, axis=1)) > np.cos(np.radians(30.0))
    return np.asarray(distance[np.isfinite(distance) & opposed], dtype=np.float64)


def _ray_scene(mesh: trimesh.Trimesh) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    vertices = o3d.core.Tensor(np.asarray(mesh.vertices, dtype=np.float32))
    scene.add_triangles(vertices, o3d.core.Tensor(np.asarray(mesh.faces, dtype=np.uint32)))
    return scene


def _directions(count: int) -> NDArray[np.float64]:
    """(count, 3) unit vectors spread evenly over half a sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z, angle = k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    level = np.sqrt(1.0 - z * z)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)


def _model(name: str, mesh: trimesh.Trimesh, colour: tuple[int, int, int]) -> ObjectModel:
    hull = mesh.convex_hull
    parts = (hull,) if hull.volume < 1.01 * mesh.volume else convex_decomposition(mesh)
    density = min(DENSITY, HEAVIEST / float(mesh.volume))
    return ObjectModel(name, FAMILY, {}, mesh, colour, density, FRICTION, parts=parts)
