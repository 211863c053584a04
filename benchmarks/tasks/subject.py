"""What the tasks measure: a detector as the node makes it, and clouds as the preprocessor gives them.

Nothing here loads torch before a network is asked for, so that other models' memory is their own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.clouds import GivenCloud
from benchmarks.models import PRECISIONS, choose_model, precision, ready_model
from benchmarks.nodes_config import node_parameters
from regnet_core.detector import Detection, DetectorConfig, GraspDetector
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box
from regnet_core.gripper import Gripper
from regnet_core.models import load_model
from regnet_core.preprocessing import Preprocessed, PreprocessingConfig, preprocess

if TYPE_CHECKING:
    from regnet_core.nn.config import NetworkConfig


class Prepared:
    """A cloud, and what the preprocessor makes of it."""

    def __init__(self, cloud: GivenCloud, points: int, crop: Sequence[float] = ()) -> None:
        """Args:
        cloud: as the camera gives it.
        points: the most that the preprocessor passes on; 0: as config/regnet.yaml says.
        crop: lower and upper corner of the workspace, six numbers [m]; nothing is cropped when empty.
        """
        parameters = node_parameters("preprocessor")
        self.cloud = cloud
        self.config = PreprocessingConfig(
            workspace=workspace_of(crop),
            voxel_size=parameters["voxel_size"],
            max_points=points or parameters["max_points"],
            seed=parameters["seed"],
        )
        self.result = self.preprocess()

    def preprocess(self) -> Preprocessed:
        """What the preprocessor node computes."""
        cloud = self.cloud
        return preprocess(cloud.points, cloud.colors, cloud.T_target_cloud, self.config)


def workspace_of(crop: Sequence[float]) -> Box | None:
    """The box of six numbers, or none.

    Raises:
        InvalidInputError: there are more or fewer numbers, or they describe no box.
    """
    if not crop:
        return None
    if len(crop) != 6:
        raise InvalidInputError(f"a crop is six numbers, its lower and its upper corner [m], got {list(crop)}")
    return Box((crop[0], crop[1], crop[2]), (crop[3], crop[4], crop[5]))


class Subject:
    """A detector as the node makes it."""

    def __init__(self, model: str, weights_seed: int, wanted: str, width: float) -> None:
        """Args:
        model: as ``choose_model`` takes it.
        weights_seed: of random weights.
        wanted: "int8", "bf16", "fp32", or "" for the processor's choice.
        width: of the gripper [m].
        """
        self._stack = ExitStack()
        for known in PRECISIONS:
            if known == wanted:
                self._stack.enter_context(precision(known))
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        self.model = ready_model(choose_model(model, weights_seed), folder, weights_seed)
        self._detector = GraspDetector(
            self.model, "cpu", config=DetectorConfig(max_grasps=node_parameters("detector")["max_grasps"])
        )
        self.gripper = Gripper(width=width)
        self.proposer: Any = load_model(self.model, "cpu").proposer
        self.network: NetworkConfig | None = _config(self.proposer)

    def detect(self, prepared: Preprocessed, gripper: Gripper | None = None) -> Detection:
        """Cloud to ranked grasps."""
        return self._detector.detect(prepared.points, gripper or self.gripper, prepared.colors)

    @property
    def levels(self) -> int:
        """Of the network's hierarchy; 0 for other models."""
        return 0 if self.network is None else len(self.network.abstractions)

    def close(self) -> None:
        """Undo the choice of the precision, remove random weights."""
        self._stack.close()


def _config(proposer: Any) -> NetworkConfig | None:
    """Of the network of a proposer; None of other models, learned baselines included."""
    network = getattr(proposer, "network", None)
    if network is None:
        return None
    from regnet_core.nn.network import RegNet

    return network.config if isinstance(network, RegNet) else None
