"""Why a detection gave no grasp, in a sentence for a person."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from regnet_core.gripper import Gripper
from regnet_core.report import StepReport
from regnet_core.scene import Scene

_ROOM = 30.0
"""Clouds that spread wider than this [m] are probably in millimetres."""


def explain(
    steps: Sequence[StepReport], scene: Scene, gripper: Gripper, least_points: int, targeted: bool = False
) -> str:
    """One sentence about the step that left nothing, and what to do where that is known.

    Args:
        steps: all steps of the detection.
        scene: the prepared cloud.
        gripper: the hand.
        least_points: how many points on objects are needed to look for grasps.
        targeted: whether the user gave a target region.
    """
    names = [step.name for step in steps]
    valid, workspace = steps[names.index("valid points")], steps[names.index("points in workspace")]
    if valid.kept + valid.rejected == 0:
        return "the cloud is empty"
    if valid.kept == 0:
        return f"none of the {valid.rejected} points is valid: all are NaN, infinite or more than 1000 m away"
    if workspace.kept == 0:
        return f"none of the {valid.kept} valid points lies in the workspace"
    if "proposals" not in names:
        return _no_surface(steps[names.index("points on objects")].kept, scene, least_points) + _doubts(scene)
    first = names.index("proposals")
    proposals = steps[first]
    if proposals.kept + proposals.rejected == 0:
        where = "the target region contains" if targeted else "there is"
        return f"{where} no point of an object that looks as if it could be grasped" + _doubts(scene)
    if proposals.kept == 0:
        return (
            f"none of {proposals.rejected} candidates closes on two opposing surfaces within the gripper's "
            f"width of {gripper.width:g} m" + _doubts(scene)
        )
    last = next(step for step in steps[first:] if step.kept == 0)
    refused = ", ".join(f"{step.name} {step.rejected}" for step in steps[first + 1 :] if step.rejected)
    return f"all {proposals.kept} proposed grasps were rejected, the last ones by: {last.name} ({refused})"


def _no_surface(found: int, scene: Scene, least_points: int) -> str:
    if found == 0 and scene.plane is not None:
        return "nothing stands on the support plane (isolated points do not count)"
    where = "above the support plane" if scene.plane is not None else "in the cloud, and no support plane in it"
    if found == 0:
        return f"there is no surface {where}: isolated points do not count"
    return f"there are only {found} points on surfaces {where}; at least {least_points} are needed"


def _doubts(scene: Scene) -> str:
    """What looks wrong about the cloud as a whole, as the end of a sentence."""
    spread = np.ptp(np.quantile(scene.points, [0.05, 0.95], axis=0), axis=0).max()
    if spread > _ROOM:
        return f"; the cloud is {spread:.0f} m wide: are its points in metres?"
    if scene.plane is not None:
        height = scene.plane.height(scene.points)
        if (height < -0.03).sum() > (height > 0.03).sum():
            return "; most of what is not on the support plane lies below it: does z point up?"
    return ""
