"""Grasp detection in point clouds for parallel-jaw grippers of any width. No ROS in here."""

from regnet_core.detector import Detection, DetectorConfig, GraspDetector
from regnet_core.errors import CloudError, GripperError, InvalidInputError, ModelError, RegnetError
from regnet_core.filters import GraspFilters
from regnet_core.geometry import Box, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.models import available_models
from regnet_core.policy import AnalyticPolicy, HeuristicPolicy, SelectionLimits, make_policy, select
from regnet_core.report import DetectionReport, StepReport

__version__ = "0.1.0"

__all__ = [
    "AnalyticPolicy",
    "Box",
    "CloudError",
    "Detection",
    "DetectionReport",
    "DetectorConfig",
    "GraspDetector",
    "GraspFilters",
    "Grasps",
    "Gripper",
    "GripperError",
    "HeuristicPolicy",
    "InvalidInputError",
    "ModelError",
    "Plane",
    "RegnetError",
    "SelectionLimits",
    "StepReport",
    "available_models",
    "make_policy",
    "select",
]
