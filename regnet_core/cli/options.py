"""The options of ``regnet detect``, each with its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from regnet_core.gripper import Gripper
from regnet_core.policy import POLICIES

BoxNumbers = tuple[float, float, float, float, float, float]

_GRIPPER, _CLOUD, _FILTERS, _OUTPUT = "Gripper", "Cloud", "Which grasps", "Output"
_BOX = "XMIN YMIN ZMIN XMAX YMAX ZMAX"


def _range(name: str) -> str:
    low, high = Gripper.LIMITS[name]
    return f"{low:g} to {high:g} m."


Files = Annotated[
    list[Path],
    typer.Argument(
        help="Point clouds: .pcd, .ply, .npy, .npz (points, optionally colors), or MCAP bags (a folder or an .mcap "
        "file). z must point up: bags are brought into the root of their transforms, files are taken as they are.",
        metavar="FILE...",
        show_default=False,
    ),
]
Widths = Annotated[
    list[float] | None,
    typer.Option(
        "--gripper-width",
        "-w",
        help=f"Largest opening between the fingers; give it several times to compare widths. {_range('width')}",
        show_default=f"{Gripper().width:g}",
        rich_help_panel=_GRIPPER,
    ),
]
Depth = Annotated[
    float, typer.Option("--gripper-depth", help=f"Length of the fingers. {_range('depth')}", rich_help_panel=_GRIPPER)
]
Height = Annotated[
    float,
    typer.Option(
        "--gripper-height",
        help=f"Extent of hand and fingers across the closing direction. {_range('height')}",
        rich_help_panel=_GRIPPER,
    ),
]
Thickness = Annotated[
    float,
    typer.Option("--gripper-thickness", help=f"Thickness of a finger. {_range('thickness')}", rich_help_panel=_GRIPPER),
]
PalmDepth = Annotated[
    float,
    typer.Option(
        "--gripper-palm-depth",
        help=f"How far the hand reaches behind the fingers. {_range('palm_depth')}",
        rich_help_panel=_GRIPPER,
    ),
]
Model = Annotated[
    str,
    typer.Option(help="What detects the grasps: one of `regnet models`, or the path of a network's .safetensors."),
]
Device = Annotated[
    str, typer.Option(help="Where it runs: auto, cpu, cuda or cuda:N. auto is a GPU where torch can use one.")
]
Seed = Annotated[int, typer.Option(min=0, help="The same seed gives the same grasps.")]
PolicyName = Annotated[
    str, typer.Option("--policy", help=f"What selects the grasp to execute: {' or '.join(POLICIES)}.")
]
Topic = Annotated[
    str | None, typer.Option(help="Topic of the clouds, for a bag that has several.", rich_help_panel=_CLOUD)
]
MessageNumber = Annotated[
    int | None,
    typer.Option("--message", min=0, help="Which cloud of a bag, from 0.", show_default="0", rich_help_panel=_CLOUD),
]
AllMessages = Annotated[bool, typer.Option("--all", help="Every cloud of a bag.", rich_help_panel=_CLOUD)]
SensorPose = Annotated[
    BoxNumbers | None,
    typer.Option(
        help="Pose of the cloud's frame in a frame with z up: position in m and roll, pitch, yaw in rad. "
        "For clouds in a camera's frame whose transform the bag lacks; replaces that of the bag.",
        metavar="X Y Z R P Y",
        show_default=False,
        rich_help_panel=_CLOUD,
    ),
]
Viewpoint = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        help="Where the camera was, in the frame of the grasps, in m. Known by itself for clouds in a camera's frame.",
        metavar="X Y Z",
        show_default=False,
        rich_help_panel=_CLOUD,
    ),
]
Crop = Annotated[
    BoxNumbers | None,
    typer.Option(
        help="Use only the points in this box, in m, in the frame of the grasps.",
        metavar=_BOX,
        show_default=False,
        rich_help_panel=_CLOUD,
    ),
]
Target = Annotated[
    BoxNumbers | None,
    typer.Option(
        help="Only grasps of what lies in this box, in m; the rest of the cloud still counts as an obstacle.",
        metavar=_BOX,
        show_default=False,
        rich_help_panel=_FILTERS,
    ),
]
MinQuality = Annotated[float, typer.Option(help="Least quality, 0 to 1.", rich_help_panel=_FILTERS)]
ApproachAngle = Annotated[
    float,
    typer.Option(
        help="Largest angle between the approach and straight down, in degrees; 180 accepts all.",
        rich_help_panel=_FILTERS,
    ),
]
Top = Annotated[int, typer.Option(min=0, help="Rows of the table of grasps.", rich_help_panel=_OUTPUT)]
Out = Annotated[
    Path | None,
    typer.Option(
        help="Write the grasps to this .json (all results) or .npz (one result, for Grasps.load).",
        show_default=False,
        rich_help_panel=_OUTPUT,
    ),
]
ViewFile = Annotated[
    Path | None,
    typer.Option(
        "--view",
        help="Draw cloud and grasps: NAME.html writes an interactive page and NAME.png, NAME.png the picture alone.",
        show_default=False,
        rich_help_panel=_OUTPUT,
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.", rich_help_panel=_OUTPUT)]
AsJson = Annotated[
    bool,
    typer.Option("--json", help="Print the results as JSON instead of tables.", rich_help_panel=_OUTPUT),
]
