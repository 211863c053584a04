"""What the nodes must give for each bag, computed by the library alone: `python tools/make_golden.py`.

Writes test/bags/golden/<model>/<bag>.json. Every cloud of a bag goes through the same two functions as in the nodes
(regnet_core.preprocessing.preprocess and GraspDetector.detect) with the parameters of config/regnet.yaml and on the
CPU, but without nodes, DDS or replay; test/ros/test_pipeline_live.py plays the bags to running nodes and compares. Run
it again after a change that is meant to change results, and look at the difference before committing it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from regnet_core import Detection, DetectorConfig, GraspDetector
from regnet_core.geometry import Array, pose_matrix
from regnet_core.grasps import Grasps
from regnet_core.io.bags import BagCloud, read_bag_clouds
from regnet_core.models import DEFAULT_MODEL
from regnet_core.policy import select
from regnet_core.preprocessing import preprocess
from regnet_core.support_plane import fit_support_plane
from regnet_ros.parameters import NodeParameters, Table, checked_value
from regnet_ros.settings import DetectorParameters, PreprocessorParameters, SelectorParameters

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = ROOT / "test" / "bags" / "golden"
TOPIC = "/camera/depth/points"
MODELS = ("antipodal", DEFAULT_MODEL)
_BEST = 30
"""So many of the best grasps of each cloud are kept."""


def main(arguments: list[str] | None = None) -> int:
    """Write the golden file of every model and bag, or of those named."""
    parser = argparse.ArgumentParser(description="Compute what the nodes must give for each bag.")
    parser.add_argument("bags", nargs="*", help="names of folders in bags/; all when none is given")
    parser.add_argument("--model", action="append", help=f"default: {' and '.join(MODELS)}")
    options = parser.parse_args(arguments)
    names = options.bags or sorted(p.parent.name for p in ROOT.glob("bags/*/metadata.yaml"))
    for model in options.model or MODELS:
        for name in names:
            content = golden(ROOT / "bags" / name, model)
            target = GOLDEN / model / f"{name}.json"
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(json.dumps(content, indent=1) + "\n")
            print(f"{target.relative_to(ROOT)}: {', '.join(str(c['grasps']) for c in content['clouds'])} grasps")
    return 0


def golden(bag: Path, model: str) -> dict[str, Any]:
    """The content of one golden file."""
    clouds = list(read_bag_clouds(bag, TOPIC))
    more = {"sensor_pose": _sensor_pose(clouds[0])}
    preprocessor = _settings("preprocessor", PreprocessorParameters, **more)
    detector = _settings("detector", DetectorParameters, model=model, device="cpu")
    selector = _settings("selector", SelectorParameters)
    return {
        "made_by": f"python tools/make_golden.py --model {model} {bag.name}",
        "preprocessor_parameters": more,
        "clouds": [_expected(cloud, preprocessor, detector, selector) for cloud in clouds],
    }


def _expected(
    cloud: BagCloud, preprocessor: PreprocessorParameters, detector: DetectorParameters, selector: SelectorParameters
) -> dict[str, Any]:
    pose = preprocessor.sensor_pose
    in_target = cloud.frame_id == preprocessor.target_frame
    T_target_cloud = np.eye(4) if in_target else pose_matrix(pose[:3], pose[3:])
    prepared = preprocess(cloud.points, cloud.colors, T_target_cloud, preprocessor.config)
    plane = fit_support_plane(prepared.points, np.random.default_rng(preprocessor.seed))
    # Clouds travel as float32.
    points = prepared.points.astype(np.float32)
    found = GraspDetector(
        detector.model, detector.device, detector.seed, DetectorConfig(max_grasps=detector.max_grasps)
    )
    detection = found.detect(points, detector.gripper, prepared.colors, filters=detector.filters)
    return {
        "stamp_ns": cloud.stamp_ns,
        "prepared_points": len(points),
        "plane_height": None if plane is None else round(float(plane.offset), 5),
        "grasps": len(detection.grasps),
        "has_reason": detection.report.reason != "",
        "steps": [step.name for step in detection.report.steps],
        "best": [_grasp(grasp) for grasp in detection.grasps[:_BEST]],
        "selected_score": _selected_score(detection, selector),
    }


def _grasp(grasp: Grasps) -> dict[str, Any]:
    return {
        "position": np.round(grasp.translation[0], 5).tolist(),
        "approach": np.round(grasp.approach[0], 4).tolist(),
        "closing": np.round(grasp.closing[0], 4).tolist(),
        "width": round(float(grasp.width[0]), 5),
        "quality": round(float(grasp.quality[0]), 4),
    }


def _selected_score(detection: Detection, selector: SelectorParameters) -> float | None:
    chosen = select(detection.grasps, selector.make_policy(selector.policy), selector.limits)
    return None if chosen is None else round(chosen.score, 4)


def _sensor_pose(cloud: BagCloud) -> list[float]:
    """x, y, z, roll, pitch, yaw of the cloud's frame in the bag's root; the parameter's way to say what tf2 knows."""
    pose: Array = np.eye(4) if cloud.T_root_cloud is None else cloud.T_root_cloud
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
    return [round(float(number), 9) for number in (*pose[:3, 3], *angles)]


def _settings(node: str, table: type[Table], **more: Any) -> Table:
    content: dict[str, Any] = yaml.safe_load((ROOT / "config" / "regnet.yaml").read_text())
    section: dict[str, Any] = content[f"/**/{node}"]["ros__parameters"]
    settings: NodeParameters = table(**{k: checked_value(table, k, v) for k, v in (section | more).items()})
    settings.check()
    assert isinstance(settings, table)
    return settings


if __name__ == "__main__":
    sys.exit(main())
