"""The MuJoCo model of a table, fixtures and free objects, to which others add hands or cameras."""

from collections.abc import Sequence

import mujoco
import numpy as np

from regnet_core.data.objects.models import ObjectModel
from regnet_core.geometry import Box

TABLE_FRICTION = 0.5
"""Sliding friction coefficient of the table and of fixtures."""


def contact_options(timestep: float) -> dict[str, object]:
    """Stiff contacts, so that resting objects sink by far less than a depth camera's noise; timestep in [s]."""
    return {"solref": [2.5 * timestep, 1.0], "solimp": [0.95, 0.99, 0.001, 0.5, 2.0], "condim": 6}


def world_spec(
    objects: Sequence[ObjectModel], table: Box, fixtures: Sequence[Box] = (), timestep: float = 0.002
) -> mujoco.MjSpec:
    """A model with one free body per object, in their order and under their names, all at the world's origin.

    The free joints come first in qpos and qvel: object k has qpos[7 k : 7 k + 7] and qvel[6 k : 6 k + 6], as long as
    whoever adds bodies adds them after this.

    Args:
        objects: K models; each becomes its convex parts.
        table: the table top, static.
        fixtures: other static boxes, such as the walls of a bin.
        timestep: of the physics [s].
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    contact = contact_options(timestep)
    for box in (table, *fixtures):
        lower, upper = np.array(box.lower), np.array(box.upper)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=0.5 * (lower + upper),
            size=0.5 * (upper - lower),
            friction=[TABLE_FRICTION, 0.005, 0.001],
            **contact,
        )
    for k, item in enumerate(objects):
        _add_object(spec, k, item, contact)
    return spec


def _add_object(spec: mujoco.MjSpec, k: int, item: ObjectModel, contact: dict[str, object]) -> None:
    body = spec.worldbody.add_body(name=item.name, mass=item.mass, ipos=[0.0, 0.0, 0.0])
    inertia = item.inertia
    body.fullinertia = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    body.explicitinertial = True
    body.add_freejoint()
    for j, part in enumerate(item.convex_parts):
        name = f"{k}_{j}"
        spec.add_mesh(name=name, uservert=part.vertices.ravel(), userface=part.faces.ravel().astype(np.int32))
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            friction=[item.friction, 0.005, 0.001],
            **contact,
        )
