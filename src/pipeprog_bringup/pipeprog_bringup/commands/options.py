# SPDX-License-Identifier: Apache-2.0
"""Options that several commands have, each declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Boq = Annotated[
    Path,
    typer.Option(
        "--boq",
        help="Bill of quantities: the planned classes. Example: `--boq plan.xlsx`",
        metavar="BOQ.yaml|csv|xlsx|ifc",
    ),
]
Board = Annotated[
    Path | None,
    typer.Option(
        "--board", help="Target boards (YAML): the scale. Example: `--board boards/a4.yaml`", metavar="BOARD.yaml"
    ),
]
Out = Annotated[Path, typer.Option("--out", help="Folder for the results. Example: `--out out/monday`", metavar="DIR")]
Force = Annotated[bool, typer.Option("--force", help="Replace earlier results of that name.")]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Change a setting (docs/parameters.md); may be repeated. Example: `--set detect.seed=3`",
        metavar="NODE.PARAM=VALUE",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress and no notes: errors and results alone.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, for programs, in place of tables.")]
ImageTopic = Annotated[
    str | None,
    typer.Option(
        help="Image topic, where there are several cameras. Example: `--image-topic /camera/image/compressed`",
        metavar="TOPIC",
    ),
]
CameraInfoTopic = Annotated[
    str | None,
    typer.Option(
        help="CameraInfo topic of that camera. Example: `--camera-info-topic /camera/camera_info`", metavar="TOPIC"
    ),
]
OdometryTopic = Annotated[
    str | None,
    typer.Option(
        help="Odometry topic, where there are several. Example: `--odometry-topic /spot/odometry`", metavar="TOPIC"
    ),
]
ImuTopic = Annotated[
    str | None,
    typer.Option(help="IMU topic, where there are several. Example: `--imu-topic /camera/imu`", metavar="TOPIC"),
]
