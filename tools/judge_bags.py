"""Judges a detector's grasps on the recordings in bags/ against the true meshes.

    python tools/judge_bags.py [--bags bags] [--only clutter_10 ...] [--model regnetv2-s] [--width 0.08] [--top 100]

For each cloud: how many grasps, how many of the best ones are free of collision with the true meshes (python-fcl),
their mean true antipodal score (ray casting), the largest distance between the contacts of any returned grasp, the
share of all returned grasps that stand in something wider than the gripper, and the time of the detection.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from regnet_core.data.bags import POINTS_TOPIC, STATIC_TOPIC
from regnet_core.data.scenes.scene import Scene
from regnet_core.detector import GraspDetector
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.geometry import matrix_from_quaternion, transform_points
from regnet_core.gripper import Gripper
from regnet_core.models import DEFAULT_MODEL

HEADER = f"{'cloud':22s}  points grasps   free    s_q s_q free  1 obj  widest too wide    time"


class Judgement(NamedTuple):
    """One cloud's figures."""

    grasps: float
    """Number of grasps returned."""
    free: float
    """Share of the top grasps that are free of collision; NaN without grasps."""
    score: float
    """Mean true antipodal score of the top grasps, colliding ones included."""
    score_free: float
    """Mean true antipodal score of those of them that are free of collision."""
    same_object: float
    """Share of the top grasps whose pads touch one and the same object."""
    widest: float
    """Largest distance between the contacts of any returned grasp [m]."""
    too_wide: float
    """Share of all returned grasps whose target is wider than the gripper where they hold it."""
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bags", type=Path, default=Path("bags"), help="folder of the bags")
    parser.add_argument("--only", nargs="*", default=["clutter_10", "clutter_20"], help="names of the bags to judge")
    parser.add_argument("--model", default=DEFAULT_MODEL)
    parser.add_argument("--width", type=float, default=0.08, help="gripper width [m]")
    parser.add_argument("--top", type=int, default=100, help="how many of the best grasps are judged")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    detector = GraspDetector(model=arguments.model, seed=arguments.seed)
    gripper = Gripper(width=arguments.width)
    print(HEADER)
    everything: list[Judgement] = []
    for name in arguments.only:
        folder = arguments.bags / name
        scene = Scene.load(folder / "scene.glb")
        truth = GroundTruth(scene.world_meshes(), scene.table)
        for i, points in enumerate(read_world_clouds(folder)):
            result = judge(detector, points, gripper, truth, arguments.top)
            everything.append(result)
            print(f"{name + f' #{i}':22s} {len(points):7d} {line(result)}", flush=True)
    if everything:
        print(f"{'mean':22s} {'':7s} {line(Judgement(*np.nanmean(np.array(everything), axis=0).tolist()))}")


def judge(
    detector: GraspDetector, points: NDArray[np.float32], gripper: Gripper, truth: GroundTruth, top: int
) -> Judgement:
    """Detects on one cloud (N, 3) in the world frame and judges the result."""
    start = time.perf_counter()
    grasps = detector.detect(points, gripper).grasps
    seconds = time.perf_counter() - start
    if len(grasps) == 0:
        nan = float("nan")
        return Judgement(0, nan, nan, nan, nan, nan, nan, seconds)
    contacts = truth.antipodal(grasps, gripper)
    best = slice(0, top)
    free = ~truth.collides(grasps[best], gripper)
    score = contacts.score[best]
    widths = contacts.contact_width[np.isfinite(contacts.contact_width)]
    too_wide = np.nan_to_num(truth.enclosed_width(grasps, gripper)) > gripper.width
    return Judgement(
        grasps=len(grasps),
        free=float(free.mean()),
        score=float(score.mean()),
        score_free=float(score[free].mean()) if free.any() else float("nan"),
        same_object=float((contacts.object_index[best] >= 0).mean()),
        widest=float(widths.max()) if len(widths) else float("nan"),
        too_wide=float(too_wide.mean()),
        seconds=seconds,
    )


def line(result: Judgement) -> str:
    """The figures as columns of the table."""
    return (
        f"{result.grasps:6.0f} {100 * result.free:5.1f}% {result.score:6.3f} {result.score_free:8.3f}"
        f" {100 * result.same_object:5.1f}% {1000 * result.widest:5.1f}mm"
        f" {100 * result.too_wide:7.1f}% {result.seconds:6.3f}s"
    )


def read_world_clouds(folder: Path) -> Iterator[NDArray[np.float32]]:
    """The points (N, 3) of each cloud of a bag made by make_bags.py, in the world frame, without NaN."""
    transforms: dict[str, tuple[str, NDArray[np.float64]]] = {}
    with AnyReader([folder]) as reader:
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == STATIC_TOPIC:
                transforms.update({t.child_frame_id: (t.header.frame_id, _matrix(t)) for t in message.transforms})
            elif connection.topic == POINTS_TOPIC:
                columns = message.data.view(np.float32).reshape(-1, message.point_step // 4)
                points = columns[np.isfinite(columns[:, :3]).all(axis=1), :3]
                frame = message.header.frame_id
                while frame != "world":
                    frame, T = transforms[frame]
                    points = transform_points(T, points).astype(np.float32)
                yield points


def _matrix(stamped: Any) -> NDArray[np.float64]:
    t, q = stamped.transform.translation, stamped.transform.rotation
    T = np.eye(4)
    T[:3, :3] = matrix_from_quaternion(np.array([[q.x, q.y, q.z, q.w]]))[0]
    T[:3, 3] = t.x, t.y, t.z
    return T


if __name__ == "__main__":
    main()
