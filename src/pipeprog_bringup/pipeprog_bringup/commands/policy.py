# SPDX-License-Identifier: Apache-2.0
"""`pipeprog policy`."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Force
from pipeprog_bringup.commands.speech import say


class Transport(str, Enum):
    """Topics of images that are subscribed, as the launch file names them."""

    raw = "raw"
    compressed = "compressed"


def policy(
    out: Annotated[
        Path, typer.Option("--out", help="The policy to write. Example: `--out policy.xml`", metavar="POLICY.xml")
    ],
    namespace: Annotated[
        str, typer.Option(help="Namespace of the nodes. Example: `--namespace robot7`", metavar="NAME")
    ] = "",
    enclaves: Annotated[
        str,
        typer.Option(
            help="Folder of the nodes' enclaves in the keystore. Example: `--enclaves /robot7`", metavar="DIR"
        ),
    ] = "/pipeprog",
    image: Annotated[
        str, typer.Option(help="Topic of raw images. Example: `--image /camera/image_raw`", metavar="TOPIC")
    ] = "image",
    compressed_image: Annotated[
        str,
        typer.Option(
            help="Topic of JPEG or PNG images; without it IMAGE/compressed. "
            "Example: `--compressed-image /camera/compressed`",
            metavar="TOPIC",
        ),
    ] = "",
    camera_info: Annotated[
        str,
        typer.Option(help="Topic of the calibration. Example: `--camera-info /camera/camera_info`", metavar="TOPIC"),
    ] = "camera_info",
    cameras: Annotated[
        str,
        typer.Option(
            help="Several cameras: what their topics begin with, between spaces. "
            "Example: `--cameras '/spot/camera/frontleft /spot/camera/frontright'`",
            metavar="NAMES",
        ),
    ] = "",
    odometry: Annotated[
        str, typer.Option(help="Topic of the odometry. Example: `--odometry /spot/odometry`", metavar="TOPIC")
    ] = "odometry",
    imu: Annotated[str, typer.Option(help="Topic of the IMU. Example: `--imu /camera/imu`", metavar="TOPIC")] = "imu",
    image_transport: Annotated[
        Transport, typer.Option(help="Which topics of images are subscribed. Example: `--image-transport raw`")
    ] = Transport.compressed,
    use_sim_time: Annotated[bool, typer.Option("--use-sim-time", help="The nodes take the time from /clock.")] = False,
    record: Annotated[bool, typer.Option("--record", help="The node survey records what the robot sends.")] = False,
    publish_tf: Annotated[
        bool, typer.Option("--publish-tf", help="The parameter publish_tf of the node sfm is true.")
    ] = False,
    force: Force = False,
) -> None:
    """Write the SROS2 access policy of the nodes that `pipeprog.launch.py` starts with the same arguments.

    `pipeprog policy --image /camera/image_raw --camera-info /camera/camera_info --out policy.xml`
    """
    from pipeprog_bringup.access_policy import GraphNames, policy_xml
    from pipeprog_bringup.results.atomic_output import output_file

    names = GraphNames(
        namespace=namespace,
        enclaves=enclaves,
        image=image,
        compressed_image=compressed_image,
        camera_info=camera_info,
        cameras=tuple(cameras.split()),
        odometry=odometry,
        imu=imu,
        image_transport=image_transport.value,
        use_sim_time=use_sim_time,
        record=record,
        publish_tf=publish_tf,
    )
    content = policy_xml(names)
    with output_file(out, force) as file:
        file.write_text(content)
    say(f"policy of the enclaves {enclaves}/frames, sfm, detect and survey: {out}")
