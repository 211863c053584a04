"""Times one detection and its steps on recorded clouds; medians over clouds and repetitions.

python benchmarks/detection.py [--bags BAG ...] [--points 25600] [--width 0.08] [--model NAME] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
from collections import defaultdict
from pathlib import Path
from statistics import median

import numpy as np

from regnet_core import GraspDetector, Gripper
from regnet_core.io.bags import read_bag_clouds
from regnet_core.models import DEFAULT_MODEL
from regnet_core.pointcloud import random_sample


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bags", type=Path, nargs="+", default=[Path("bags/clutter_10"), Path("bags/clutter_20")])
    parser.add_argument("--points", type=int, default=0, help="draw so many points of each cloud; 0: all")
    parser.add_argument("--width", type=float, default=0.08, help="gripper width [m]")
    parser.add_argument("--model", default=DEFAULT_MODEL, help="a name or the path of weights")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--repeat", type=int, default=5, help="repetitions, after one that does not count")
    parser.add_argument("--json", type=Path, help="also write the seconds of every detection")
    options = parser.parse_args()
    clouds = [cloud.points for bag in options.bags for cloud in read_bag_clouds(bag)]
    clouds = [points[np.isfinite(points).all(axis=1)] for points in clouds]
    if options.points:
        clouds = [points[random_sample(len(points), options.points, np.random.default_rng(0))] for points in clouds]
    detector = GraspDetector(options.model, options.device)
    seconds = measure(detector, Gripper(width=options.width), clouds, options.repeat)
    sizes = [len(points) for points in clouds]
    print(f"{detector.model} on {detector.device}")
    print(f"{len(clouds)} clouds of {min(sizes)} to {max(sizes)} points, {len(os.sched_getaffinity(0))} cores")
    print(f"{'step':24s} {'median':>8s} {'least':>8s} {'most':>8s}  [ms]")
    for name, values in seconds.items():
        print(f"{name:24s} {1e3 * median(values):8.1f} {1e3 * min(values):8.1f} {1e3 * max(values):8.1f}")
    if options.json:
        options.json.write_text(json.dumps(seconds, indent=1) + "\n", encoding="utf-8")


def measure(
    detector: GraspDetector, gripper: Gripper, clouds: list[np.ndarray], repetitions: int
) -> dict[str, list[float]]:
    """Seconds of each step and of the whole detection, for every cloud and repetition but the first."""
    seconds: dict[str, list[float]] = defaultdict(list)
    for repetition in range(repetitions + 1):
        for points in clouds:
            report = detector.detect(points, gripper).report
            if repetition == 0:
                continue
            for step in report.steps:
                seconds[step.name].append(step.seconds)
            seconds["total"].append(report.total_seconds)
    return dict(seconds)


if __name__ == "__main__":
    main()
