"""Detections as one self-contained interactive page, which works without a network."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array
from regnet_core.view.camera import clearest_azimuth
from regnet_core.view.meshes import Mesh, approach_arrow, fork_mesh, gripper_mesh, joined
from regnet_core.view.palette import SELECTED, css, height_colors, rank_colors
from regnet_core.view.scene import ViewScene, spread_out, thinned

_MAX_POINTS = 60_000
_SPOTS = 20
_GROUPS = ((0, 10), (10, 30), (30, 60))
"""Ranks that are switched on and off together."""
_EVERY_SCENE = -1
_MARGIN = 0.12
"""What is shown around the objects [m]."""
_LIGHTING = {"ambient": 0.75, "diffuse": 0.5, "specular": 0.05, "roughness": 0.9, "fresnel": 0.01}
_PAGE = Template(
    """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>$title</title>
<style>body { margin: 0; overflow: hidden; background: #f6f8fb }</style>
</head>
<body>$plot</body>
</html>
"""
)


def write_html(path: str | Path, scenes: ViewScene | Sequence[ViewScene], title: str = "Detected grasps") -> None:
    """Write a page with the cloud, the best grasps coloured by rank, and the selected grasp with its approach.

    Several scenes, for instance of several gripper widths, are switched with buttons.

    Raises:
        InvalidInputError: there is no scene, or the path does not end in .html.
    """
    target, pages = Path(path), [scenes] if isinstance(scenes, ViewScene) else list(scenes)
    if target.suffix.lower() != ".html":
        raise InvalidInputError(f"pages are written as .html, got '{target.name}'")
    if not pages:
        raise InvalidInputError("there is nothing to show: no scene was given")
    plot = _figure(pages, title).to_html(
        include_plotlyjs=True,
        include_mathjax=False,
        full_html=False,
        default_height="100vh",
        config={"displaylogo": False, "responsive": True},
    )
    target.write_text(_PAGE.substitute(title=html.escape(title), plot=plot), encoding="utf-8")


def _figure(scenes: list[ViewScene], title: str) -> go.Figure:
    shared = all(scene.points is scenes[0].points for scene in scenes)
    low, high = _bounds(scenes)
    traces: list[Any] = [_cloud_trace(scenes[0], low, high)] if shared else []
    owner = [_EVERY_SCENE] * len(traces)
    for number, scene in enumerate(scenes):
        added = [*([] if shared else [_cloud_trace(scene, low, high)]), *_grasp_traces(scene), *_selected_traces(scene)]
        traces += added
        owner += [number] * len(added)
    states = [trace.visible if trace.visible is not None else True for trace in traces]
    for trace, number in zip(traces, owner, strict=True):
        if number > 0:
            trace.visible = False
    figure = go.Figure(traces)
    figure.update_layout(
        title={"text": _heading(title, scenes[0]), "x": 0.01},
        margin={"l": 0, "r": 0, "b": 0, "t": 72},
        paper_bgcolor="#f6f8fb",
        font={"family": "system-ui, sans-serif"},
        legend={"itemsizing": "constant", "x": 0.99, "xanchor": "right", "y": 0.98, "bgcolor": "rgba(255,255,255,0.8)"},
        scene=_axes(low, high, scenes[0]),
    )
    if len(scenes) > 1:
        figure.update_layout(updatemenus=[_menu(scenes, title, owner, states)])
    return figure


def _menu(scenes: list[ViewScene], title: str, owner: list[int], states: list[Any]) -> dict[str, Any]:
    """One button for each scene, which shows its traces alone."""
    buttons = []
    for number, scene in enumerate(scenes):
        visible = [state if of in (number, _EVERY_SCENE) else False for state, of in zip(states, owner, strict=True)]
        change = [{"visible": visible}, {"title.text": _heading(title, scene)}]
        buttons.append({"label": scene.title or f"scene {number}", "method": "update", "args": change})
    place = {"x": 0.0, "xanchor": "left", "y": 1.0, "yanchor": "top", "pad": {"l": 8, "t": 8}}
    return {"type": "buttons", "direction": "down", "buttons": buttons, **place}


def _cloud_trace(scene: ViewScene, low: Array, high: Array) -> go.Scatter3d:
    near = np.flatnonzero(((scene.points >= low) & (scene.points <= high)).all(axis=1))
    cut = scene.with_points(near[thinned(len(near), _MAX_POINTS)])
    points = cut.points.astype(np.float32)
    rgb = height_colors(cut.points, cut.plane) * 255 if cut.colors is None else cut.colors
    codes = np.rint(rgb).astype(np.int64) @ np.array([65536, 256, 1])
    return go.Scatter3d(
        x=points[:, 0],
        y=points[:, 1],
        z=points[:, 2],
        mode="markers",
        marker={"size": 2.4, "color": [f"#{code:06x}" for code in codes]},
        name=f"cloud ({len(points)} of {len(scene.points)} points)",
        hoverinfo="skip",
        showlegend=True,
    )


def _grasp_traces(scene: ViewScene) -> list[go.Mesh3d]:
    """The best grasp of each spot, shown, and groups of ranks that the legend switches on."""
    count = len(scene.grasps)
    spots = [int(rank) for rank in spread_out(scene.grasps, scene.gripper, _SPOTS)]
    groups = [("best of each spot", spots)]
    groups += [(f"ranks {low} to {min(high, count) - 1}", list(range(low, min(high, count)))) for low, high in _GROUPS]
    traces = []
    for name, ranks in groups:
        ranks = [rank for rank in ranks if rank != scene.selected]
        if ranks:
            trace = _rank_trace(scene, name, ranks)
            trace.visible = True if name == groups[0][0] else "legendonly"
            traces.append(trace)
    return traces


def _rank_trace(scene: ViewScene, name: str, ranks: list[int]) -> go.Mesh3d:
    colors = rank_colors(len(ranks))
    meshes: list[Mesh] = []
    texts: list[str] = []
    faces: list[str] = []
    for rank, color in zip(ranks, colors, strict=True):
        mesh = fork_mesh(scene.gripper, float(scene.grasps.width[rank])).transformed(scene.grasps.poses[rank])
        meshes.append(mesh)
        texts += [_hover(scene, rank)] * len(mesh.vertices)
        faces += [css(color)] * len(mesh.faces)
    trace = _mesh_trace(joined(meshes), name, css(colors[0]))
    trace.update(facecolor=faces, text=texts)
    return trace


def _selected_traces(scene: ViewScene) -> list[go.Mesh3d]:
    if scene.selected is None:
        return []
    rank, pose = scene.selected, scene.grasps.poses[scene.selected]
    hand = gripper_mesh(scene.gripper, float(scene.grasps.width[rank])).transformed(pose)
    arrow = approach_arrow(scene.gripper).transformed(pose)
    traces = [
        _mesh_trace(hand, f"selected (rank {rank})", css(SELECTED)),
        _mesh_trace(arrow, "approach from the pre-grasp", css(SELECTED)),
    ]
    for trace in traces:
        trace.text = "selected<br>" + _hover(scene, rank)
    return traces


def _mesh_trace(mesh: Mesh, name: str, color: str) -> go.Mesh3d:
    x, y, z = mesh.vertices.T.astype(np.float32)
    i, j, k = mesh.faces.T.astype(np.int32)
    return go.Mesh3d(
        x=x,
        y=y,
        z=z,
        i=i,
        j=j,
        k=k,
        name=name,
        color=color,
        flatshading=True,
        lighting=_LIGHTING,
        hoverinfo="text",
        showlegend=True,
    )


def _hover(scene: ViewScene, rank: int) -> str:
    grasp = scene.grasps
    return (
        f"rank {rank}<br>quality {grasp.quality[rank]:.3f}<br>vertical {grasp.vertical_score[rank]:.3f}"
        f"<br>opening {1000 * grasp.width[rank]:.0f} mm"
    )


def _heading(title: str, scene: ViewScene) -> str:
    return f"<b>{title}</b> · {scene.title}<br><sup>{scene.caption}</sup>"


def _bounds(scenes: list[ViewScene]) -> tuple[Array, Array]:
    """Corners of the box that is shown: the objects near the grasps, the grasps, and a margin [m]."""
    parts: list[npt.NDArray[np.floating[Any]]] = [np.zeros((0, 3))]
    for scene in [scene for scene in scenes if len(scene.grasps)] or scenes:
        tips = scene.grasps.fingertips(scene.gripper)
        objects = scene.without_invalid().object_points()
        if len(tips):
            objects = objects[((objects > tips.min(axis=0) - 0.2) & (objects < tips.max(axis=0) + 0.2)).all(axis=1)]
        parts += [objects, tips]
    focus = np.concatenate(parts)
    if len(focus) == 0:
        return np.full(3, -_MARGIN), np.full(3, _MARGIN)
    low, high = np.percentile(focus, [0.5, 99.5], axis=0)
    return low - _MARGIN, high + _MARGIN


def _axes(low: Array, high: Array, scene: ViewScene) -> dict[str, Any]:
    """Axes in true proportion, seen from where the cloud has fewest holes."""
    points = scene.without_invalid().points
    azimuth = clearest_azimuth(points, (low + high) / 2, math.radians(40), scene.viewpoint)
    eye = {"x": 1.25 * math.cos(azimuth), "y": 1.25 * math.sin(azimuth), "z": 1.05}
    axes = {
        f"{axis}axis": {"range": [low[i], high[i]], "title": f"{axis} [m]", "showspikes": False}
        for i, axis in enumerate("xyz")
    }
    return {**axes, "aspectmode": "data", "camera": {"eye": eye, "center": {"x": 0.0, "y": 0.0, "z": -0.12}}}
