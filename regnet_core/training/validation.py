"""The paper's metrics on held-out scenes, for a network as for any other method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from regnet_core.data.dataset import GraspDataset, GraspSample, collate
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.evaluation.metrics import SceneMetrics, evaluate_scene
from regnet_core.geometry import Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.decoding import decode
from regnet_core.nn.network import RegNet
from regnet_core.nn.precision import autocast


@torch.no_grad()
def network_grasps(network: RegNet, sample: GraspSample, device: torch.device) -> Grasps:
    """What the network proposes for a sample, before any check, best first."""
    batch = collate([sample]).to(device)
    clouds = Clouds.stacked(batch.points, batch.width, batch.colors)
    with autocast(device):
        output = network(clouds)
    return decode(network, output, clouds)[0]


def validate(
    network: RegNet, dataset: GraspDataset, samples: Sequence[int], device: torch.device
) -> list[SceneMetrics]:
    """Metrics of single samples of a data set; the network is left in the mode that it was in."""
    training = network.training
    network.eval()
    try:
        chosen = [dataset[i] for i in samples]
        return [judge_sample(dataset.archive, one, network_grasps(network, one, device)) for one in chosen]
    finally:
        network.train(training)


def judge_sample(archive: SceneArchive, sample: GraspSample, grasps: Grasps) -> SceneMetrics:
    """The metrics of any method's grasps for a sample, through the one code that judges all."""
    scene, width = archive.scene(sample.scene), round(float(sample.width), 6)
    labels = archive.labels(sample.scene)[archive.widths.index(width)]
    truth = GroundTruth(scene.world_meshes(), scene.table, fixtures=scene.fixtures)
    plane = Plane((0.0, 0.0, 1.0), scene.table_height)
    observed = sample.points.numpy().astype(np.float64)
    return evaluate_scene(grasps, Gripper(width=width), observed, truth, labels, plane=plane)
