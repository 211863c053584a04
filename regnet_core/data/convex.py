"""Convex decomposition of a mesh for physics (CoACD, Wei et al. 2022)."""

import coacd
import numpy as np
import trimesh

CONCAVITY = 0.04
"""CoACD's threshold: the concavity that may remain, relative to the mesh's size."""
SMALLEST_PART = 1e-10
"""Parts below this volume [m^3] are slivers that the physics engine refuses."""


def convex_decomposition(
    mesh: trimesh.Trimesh, concavity: float = CONCAVITY, seed: int = 0
) -> tuple[trimesh.Trimesh, ...]:
    """Splits a watertight mesh into convex parts; the same mesh and seed give the same parts."""
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)),
        threshold=concavity,
        preprocess_mode="off",
        mcts_iterations=60,
        mcts_nodes=10,
        resolution=1000,
        seed=seed,
    )
    hulls = (trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in parts)
    return tuple(hull for hull in hulls if hull.volume > SMALLEST_PART)
