"""The stages of the way from a PointCloud2 to a GraspArray, and the functions that do the work of each.

This table is the only place that knows where in regnet_core and regnet_ros a stage is. A function that is gone, or one
that should run and does not, is an error that names the stage.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from benchmarks import stage
from benchmarks.errors import StageError
from benchmarks.stage import Stage
from regnet_core.nn.config import NetworkConfig

MESSAGE_STAGES = (
    Stage(
        "message to cloud",
        "messages",
        "a PointCloud2 of any layout, as it is received, to arrays of points and colours",
        ("regnet_ros.received_cloud:CloudReader.read", "regnet_ros.received_cloud:ReceivedCloud.decode"),
    ),
    Stage(
        "cloud to message",
        "messages",
        "arrays to a PointCloud2 (the preprocessor's output)",
        ("regnet_ros.conversions:cloud_to_message",),
    ),
    Stage(
        "grasps to message",
        "messages",
        "grasps and report to a serialized GraspArray, and to a PoseArray",
        ("regnet_ros.serialized_grasps:serialized_grasp_array", "regnet_ros.conversions:pose_array"),
    ),
    Stage(
        "markers",
        "messages",
        "grasps to a MarkerArray, and the plane to a Marker",
        ("regnet_ros.visuals:grasp_markers", "regnet_ros.visuals:plane_marker"),
    ),
    Stage(
        "serialisation",
        "messages",
        "message objects to bytes, as rclpy does it for every publication",
        ("benchmarks.messages:sent",),
    ),
)
"""What the nodes do around regnet_core; they need ROS."""

CLOUD_STAGES = (
    Stage(
        "validation",
        "preparation",
        "shapes, types, which points are finite, near enough and in the workspace; the preprocessor also transforms "
        "and draws some",
        (
            "regnet_core.pointcloud:place_points",
            "regnet_core.pointcloud:usable_rows",
            "regnet_core.pointcloud:validate_colors",
            "regnet_core.pointcloud:as_points",
        ),
    ),
    Stage(
        "sampling",
        "preparation",
        "one point of each voxel, or a look at how many share one, and random draws",
        (
            "regnet_core.pointcloud:voxel_downsample",
            "regnet_core.pointcloud:random_sample",
            "regnet_core.ops.voxels:share_kept",
        ),
    ),
)
"""What preprocessor and detector both do with a cloud."""

PREPROCESSOR_STAGES = (
    CLOUD_STAGES[0],
    replace(CLOUD_STAGES[1], needed=stage.maybe),  # where it is to thin by voxels
    Stage(
        "preprocessing, the rest",
        "preparation",
        "what else the preprocessor computes",
        ("regnet_core.preprocessing:preprocess",),
    ),
)

SCENE_STAGES = (
    *CLOUD_STAGES,
    Stage(
        "support plane",
        "preparation",
        "fitting the plane that objects stand on",
        ("regnet_core.support_plane:fit_support_plane",),
    ),
    Stage(
        "crop",
        "preparation",
        "to what lies near objects",
        ("regnet_core.pointcloud:surroundings",),
        needed=stage.maybe,
    ),
    Stage(
        "clusters",
        "preparation",
        "what hangs together, what is a wall, what lies beyond the table",
        ("regnet_core.clusters:cluster", "regnet_core.clusters:structure", "regnet_core.clusters:beyond"),
    ),
    Stage(
        "normals",
        "preparation",
        "local planes of the objects' points",
        (
            "regnet_core.pointcloud:estimate_normals",
            "regnet_core.pointcloud:neighbourhood_radius",
            "regnet_core.pointcloud:orient_normals",
        ),
    ),
    Stage(
        "hidden sides",
        "preparation",
        "the volume below what was seen, and its surface",
        (
            "regnet_core.completion:columns_of",
            "regnet_core.completion:fill_columns",
            "regnet_core.completion:hidden_surface",
            "regnet_core.completion:SolidModel.outward",
            "regnet_core.visibility:unseen_ground",
        ),
    ),
    Stage("scene, the rest", "preparation", "what else prepares the scene", ("regnet_core.scene:prepare_scene",)),
)

NETWORK_STAGES = (
    Stage(
        "network input",
        "search",
        "drawing the points that the network sees, and which of them are on objects",
        ("regnet_core.nn.proposer:NetworkProposer.propose",),
        needed=stage.network,
    ),
    Stage(
        "local shapes",
        "search",
        "covariances of neighbourhoods, for networks that take them",
        ("regnet_core.nn.clouds:with_shapes",),
        needed=stage.with_shapes,
    ),
    Stage(
        "farthest points",
        "search",
        "the centroids of all levels",
        ("regnet_core.ops.farthest_points:farthest_points",),
        needed=stage.network,
    ),
    Stage(
        "ball queries",
        "search",
        "neighbours of centroids and of regions, and the buckets that all searches look at",
        ("regnet_core.ops.ball_query:ball_query", "regnet_core.ops.buckets:point_buckets"),
        needed=stage.network,
    ),
    Stage(
        "nearest centroids",
        "search",
        "the three nearest centroids of every point that a propagation gives features",
        ("regnet_core.ops.interpolation:three_nearest",),
        needed=stage.network,
    ),
    Stage(
        "hierarchy, the rest",
        "search",
        "what else puts the levels together",
        ("regnet_core.nn.hierarchy:build_hierarchy",),
        needed=stage.network,
    ),
    Stage(
        "abstraction",
        "network",
        "a set abstraction: its layers on every neighbour, and the maximum",
        ("regnet_core.nn.set_abstraction:SetAbstraction.forward",),
        needed=stage.network,
        numbered="up",
        ledger="abstraction",
    ),
    Stage(
        "propagation",
        "network",
        "a feature propagation: interpolation, and its layers on every point; the last one where it is needed",
        ("regnet_core.nn.propagation:FeaturePropagation.forward",),
        needed=stage.network,
        numbered="down",
        ledger="propagation",
    ),
    Stage(
        "score head",
        "network",
        "the confidence of every point that may become positive",
        ("regnet_core.nn.heads:ScoreHead.forward",),
        needed=stage.network,
        ledger="score",
    ),
    Stage(
        "regions",
        "network",
        "the most confident points, and the maximum of the features around each",
        (
            "regnet_core.nn.regions:candidate_points",
            "regnet_core.nn.regions:select_regions",
            "regnet_core.nn.regions:pool_regions",
            "regnet_core.nn.regions:region_neighbours",
        ),
        needed=stage.with_regions,
    ),
    Stage(
        "grasp heads",
        "network",
        "class, residuals and quality of every anchor of every region",
        ("regnet_core.nn.heads:GraspHead.forward",),
        needed=stage.network,
        ledger="regions",
    ),
    Stage(
        "candidates",
        "network",
        "poses of the likeliest anchors, and of refined ones",
        (
            "regnet_core.nn.network:RegNet.best_anchors",
            "regnet_core.nn.network:RegNet.best_refined",
            "regnet_core.nn.network:RegNet.refined_pose",
        ),
        needed=stage.network,
    ),
    Stage(
        "closing areas",
        "search",
        "the points between the fingers of every candidate",
        ("regnet_core.nn.refinement:closing_points",),
        needed=stage.with_refinement,
    ),
    Stage(
        "refinement",
        "network",
        "the Refine Network on these points",
        ("regnet_core.nn.refinement:RefineNetwork.forward", "regnet_core.nn.refinement:RefineNetwork.carried"),
        needed=stage.with_refinement,
        ledger="refinement",
    ),
    Stage(
        "network, the rest",
        "network",
        "what is between the stages of the network",
        (
            "regnet_core.nn.network:RegNet.forward",
            "regnet_core.nn.backbone:Backbone.coarse",
            "regnet_core.nn.backbone:Backbone.fine",
            "regnet_core.nn.point_features:PointFeatures.need",
        ),
        needed=stage.network,
    ),
    Stage(
        "decoding",
        "decisions",
        "from the network's numbers to grasps, best first",
        ("regnet_core.nn.decoding:decode",),
        needed=stage.network,
    ),
)

DECISION_STAGES = (
    Stage(
        "filters",
        "decisions",
        "quality, approach cone, workspace",
        (
            "regnet_core.filters:GraspFilters.quality_ok",
            "regnet_core.filters:GraspFilters.approach_ok",
            "regnet_core.filters:GraspFilters.workspace_ok",
        ),
    ),
    Stage(
        "collision",
        "decisions",
        "of the open hand with the table and the cloud",
        (
            "regnet_core.collision:SceneCollision.__init__",
            "regnet_core.collision:hits_table",
            "regnet_core.collision:SceneCollision.with_points",
            "regnet_core.collision:SceneCollision.occupancy",
        ),
    ),
    Stage("ranking", "decisions", "best first", ("regnet_core.grasps:Grasps.ranked",)),
    Stage(
        "detection, the rest",
        "decisions",
        "what else a detection does",
        ("regnet_core.detector:GraspDetector.detect",),
    ),
)

PROPOSALS = Stage(
    "proposals",
    "network",
    "of a model that is no network",
    ("regnet_core.proposer:Proposer.propose",),
    needed=stage.other_model,
)
"""Done by the class of the model at hand."""

ALL_STAGES = tuple(
    {
        one.name: one
        for one in (
            *MESSAGE_STAGES, *PREPROCESSOR_STAGES, *SCENE_STAGES, *NETWORK_STAGES, PROPOSALS, *DECISION_STAGES
        )
    }.values()
)  # fmt: skip
"""Each once."""
PREPROCESSING = "preprocessing, the rest"
"""The stage that all of the preprocessing is inside of."""
NETWORK_ENTRY = "network, the rest"
"""The stage that all of the network is inside of."""
DETECTION = "detection, the rest"
"""The stage that all of a detection is inside of."""


def detector_stages(model: type, network: bool) -> tuple[Stage, ...]:
    """The stages of a detection.

    Args:
        model: the class of the Proposer.
        network: whether it is NetworkProposer, whose stages are known.
    """
    if network:
        return (*SCENE_STAGES, *NETWORK_STAGES, *DECISION_STAGES)
    defining = next(owner for owner in model.__mro__ if "propose" in vars(owner))
    proposals = replace(PROPOSALS, targets=(f"{defining.__module__}:{defining.__qualname__}.propose",))
    return (*SCENE_STAGES, proposals, *DECISION_STAGES)


def ledger_name(one: Stage, name: str) -> str:
    """What the ledger calls one of a stage's names; empty where it has no operations."""
    return one.ledger + name.removeprefix(one.name) if one.ledger else ""


def check_seen(stages: Iterable[Stage], config: NetworkConfig | None, seen: Iterable[str], levels: int) -> None:
    """Refuse a sample in which a stage that must run did not.

    Raises:
        StageError: such a stage is missing.
    """
    there = set(seen)
    for one in stages:
        missing = [name for name in one.names(levels) if name not in there]
        if missing and one.needed(config):
            raise StageError(
                f"the stage '{missing[0]}' did not run: no longer is its work done by {' or '.join(one.targets)}; "
                "name in benchmarks/stages.py what does it now"
            )
