# SPDX-License-Identifier: Apache-2.0
"""The command `pipeprog`.

Modules that take long to import are imported inside the commands, so that --help answers at once.
"""

from __future__ import annotations

import math
import os
import signal
import sys
from pathlib import Path
from typing import Annotated

import click
import typer

from pipeprog_camera.outside_text import for_terminal

app = typer.Typer(
    name="pipeprog",
    help="From video of a construction site to the metres of each planned pipe class that are installed.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

Boq = Annotated[
    Path, typer.Option("--boq", help="Bill of quantities: the planned classes.", metavar="BOQ.yaml|csv|xlsx|ifc")
]
Out = Annotated[Path, typer.Option("--out", help="Folder for the results.", metavar="DIR")]
Force = Annotated[bool, typer.Option("--force", help="Replace the results that --out holds.")]
Set = Annotated[
    list[str] | None, typer.Option("--set", help="Change a setting; may be repeated.", metavar="NODE.PARAM=VALUE")
]


@app.callback(invoke_without_command=True)
def options(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    """Options of the command itself."""
    if version:
        from importlib import metadata

        typer.echo(f"pipeprog {metadata.version('pipeprog')}")
        raise typer.Exit


@app.command(rich_help_panel="From recordings")
def replay(
    bag: Annotated[Path, typer.Argument(help="Recording: an .mcap, .db3 or .bag file or a rosbag2 folder.")],
    boq: Boq,
    out: Out,
    board: Annotated[
        Path | None, typer.Option("--board", help="Target boards (YAML): the scale.", metavar="BOARD.yaml")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", help="Play at R times real time; without, as fast as the nodes take it.", metavar="R"),
    ] = None,
    overrides: Set = None,
    force: Force = False,
    image_topic: Annotated[str | None, typer.Option(help="Image topic, where there are several cameras.")] = None,
    camera_info_topic: Annotated[str | None, typer.Option(help="CameraInfo topic of that camera.")] = None,
    odometry_topic: Annotated[str | None, typer.Option(help="Odometry topic, where there are several.")] = None,
    imu_topic: Annotated[str | None, typer.Option(help="IMU topic, where there are several.")] = None,
    progress: Annotated[
        Path | None,
        typer.Option("--progress", help="Keep a file at where the replay stands, for programs.", metavar="FILE.json"),
    ] = None,
) -> None:
    """Run the node graph on a recording: keyframes, metric map, classified pipes, progress."""
    from pipeprog_bringup.playback.node_processes import require_ros

    require_ros()
    from pipeprog_bringup.console import print_progress, replay_bars
    from pipeprog_bringup.playback.state_file import state_file
    from pipeprog_bringup.replay import Request
    from pipeprog_bringup.replay import replay as run

    request = Request(
        bag,
        boq,
        out,
        board,
        rate,
        overrides or (),
        force,
        image_topic,
        camera_info_topic,
        odometry_topic,
        imu_topic,
    )
    with replay_bars() as show, state_file(progress, show) as report:
        outcome = run(request, report)
    for note in outcome.notes + outcome.losses:
        _note(note)
    print_progress(outcome.product)
    _say(
        f"{outcome.frames} frames considered, {outcome.registered} of {outcome.keyframes} keyframes registered, "
        f"{len(outcome.product.pipes)} pipes: {out / 'pipes.json'}"
    )


@app.command(rich_help_panel="From recordings")
def fleet(
    recordings: Annotated[
        list[str],
        typer.Argument(
            help="Files, folders, globs, addresses such as s3://..., or a fleet.yaml.", metavar="RECORDINGS"
        ),
    ],
    out: Annotated[str, typer.Option("--out", help="Folder or address for the results.", metavar="URI")],
    boq: Annotated[
        str, typer.Option("--boq", help="Bill of quantities: the planned classes.", metavar="BOQ.yaml|csv|xlsx")
    ] = "",
    board: Annotated[str, typer.Option("--board", help="Target boards (YAML): the scale.", metavar="BOARD.yaml")] = "",
    overrides: Set = None,
    scheduler: Annotated[
        str, typer.Option("--scheduler", help="A Dask cluster; without, this machine.", metavar="tcp://HOST:8786")
    ] = "",
    cores: Annotated[int, typer.Option("--cores", help="Cores for each survey.", min=1, metavar="C")] = 2,
) -> None:
    """Survey many recordings at once; what has its results already is left as it is."""
    from pipeprog_camera.errors import InputError

    try:
        from pipeprog_bringup.survey_fleet import Request, survey_fleet
    except ModuleNotFoundError as error:
        raise InputError(
            f"pipeprog fleet needs packages that are not installed (there is no {error.name}): "
            "`pip install pipeprog[fleet]`, or in the repository `make setup FLEET=1`"
        ) from None
    from pipeprog_bringup.console import FleetDisplay
    from pipeprog_bringup.playback.node_processes import require_ros

    if not scheduler:
        require_ros()
    request = Request(recordings, out, boq, board, overrides or (), scheduler, cores)
    try:
        with FleetDisplay() as display:
            surveyed = survey_fleet(request, display)
    except KeyboardInterrupt:
        _note("Interrupted: what is done stays; the same command goes on with the rest.")
        raise typer.Exit(130) from None
    without = [row for row in surveyed.rows if row.survey is None]
    _say(f"{len(surveyed.rows) - len(without)} of {len(surveyed.rows)} recordings surveyed: {surveyed.page}")
    if without:
        raise InputError(f"{len(without)} of {len(surveyed.rows)} recordings have no results: {surveyed.page} says why")


@app.command(rich_help_panel="From recordings")
def detect(
    cloud: Annotated[Path, typer.Argument(help="Metric point cloud: ply, pcd, las, laz, e57, xyz, txt, csv, pts.")],
    boq: Boq,
    out: Out,
    force: Force = False,
    overrides: Set = None,
    plane: Annotated[
        str | None,
        typer.Option(
            "--plane",
            help="Only the pipes that a plane cuts: through three points, or a line on a keyframe of the survey whose "
            "cloud.ply it is (keyframes count from 1, as in trajectory.tum).",
            metavar="'X,Y,Z X,Y,Z X,Y,Z' | KEYFRAME:U1,V1,U2,V2",
        ),
    ] = None,
) -> None:
    """Find and classify the pipes of a metric point cloud."""
    from pipeprog_bringup.console import print_progress, share_bar
    from pipeprog_bringup.detect_cloud import detect_file
    from pipeprog_bringup.plane_from_keyframe import as_points

    cut = [] if plane is None else ["detect.front_end=planes", f"detect.plane={as_points(plane, cloud.parent)}"]
    with share_bar("detect") as report:
        detection = detect_file(cloud, boq, out, [*cut, *(overrides or [])], force, report)
    if detection.dropped:
        _note(f"{detection.dropped} points of {cloud} are not finite or beyond 1e8 m and were left out")
    print_progress(detection.product)
    _say(f"{len(detection.product.pipes)} pipes in {detection.points} points: {out / 'pipes.json'}")


@app.command(rich_help_panel="To recordings")
def ingest(
    video: Annotated[Path, typer.Argument(help="Video: mp4, mov, ...")],
    camera: Annotated[
        Path, typer.Option("--camera", help="Calibration, as ROS camera_calibration writes it.", metavar="CAMERA.yaml")
    ],
    out: Annotated[Path, typer.Option("--out", help="The recording to write.", metavar="BAG.mcap")],
    quality: Annotated[int, typer.Option(min=50, max=100, help="JPEG quality.")] = 95,
    start: Annotated[float, typer.Option("--start", help="First second of the video to take.", metavar="S")] = 0.0,
    end: Annotated[float, typer.Option("--end", help="Last second of the video to take.", metavar="S")] = math.inf,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Images a second at most; without, all.", metavar="N")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the recording that --out names.")] = False,
) -> None:
    """Make a recording of a video and its camera's calibration."""
    from pipeprog_bringup.console import share_bar
    from pipeprog_bringup.footage.shot import Excerpt
    from pipeprog_bringup.ingest import Request
    from pipeprog_bringup.ingest import ingest as run

    request = Request(video, camera, out, Excerpt(start, end, fps), quality, force)
    with share_bar("ingest") as report:
        ingested = run(request, report)
    for note in ingested.notes:
        _note(note)
    _say(f"{ingested.frames} frames of {ingested.seconds:.1f} s: {out}")


@app.command(rich_help_panel="To recordings")
def board(
    boards: Annotated[Path, typer.Argument(help="Target boards (YAML).", metavar="BOARD.yaml")],
    paper: Annotated[str, typer.Option("--paper", help="A4, A3, A2, A1, A0, letter or tabloid.", metavar="SIZE")],
    out: Annotated[Path, typer.Option("--out", help="The file to write.", metavar="BOARD.pdf")],
    force: Annotated[bool, typer.Option("--force", help="Replace the file that --out names.")] = False,
) -> None:
    """Write target boards and marks to print at true size, each with a ruler to check the print."""
    from pipeprog_bringup.results.atomic_output import output_file
    from pipeprog_sfm.boards.board_file import load_board_file
    from pipeprog_sfm.boards.board_print import board_pdf

    content = load_board_file(boards)
    pages = [*content.boards, *(disc for bar in content.scale_bars for disc in bar.discs)]
    document = board_pdf(pages, paper)
    with output_file(out, force) as file:
        file.write_bytes(document)
    _say(f"{len(pages)} page{'s' * (len(pages) > 1)}, to be printed at 100 %: {out}")


@app.command(rich_help_panel="From results")
def score(
    pipes: Annotated[Path, typer.Argument(help="pipes.json of a run.", metavar="DIR/pipes.json")],
    truth: Annotated[Path, typer.Argument(help="Ground truth.", metavar="TRUTH.json")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON in place of tables.")] = False,
) -> None:
    """Compare a result with ground truth: found, classified, radius, length, scale, trajectory."""
    import json

    from pipeprog_bringup.console import print_score
    from pipeprog_bringup.results.scoring import score_files

    figures = score_files(pipes, truth)
    if as_json:
        typer.echo(json.dumps(figures, indent=1, allow_nan=False))
    else:
        print_score(figures)


@app.command(rich_help_panel="From results")
def report(
    folders: Annotated[
        list[Path], typer.Argument(help="Results of one survey, or of several.", metavar="DIR [DIR ...]")
    ],
    out: Annotated[
        Path, typer.Option("--out", help="The page to write (.html), or a folder for it.", metavar="REPORT")
    ],
    force: Annotated[bool, typer.Option("--force", help="Replace the page that --out names.")] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Print the page to a PDF beside it, with Chromium or Chrome.")
    ] = False,
) -> None:
    """Write one HTML page: progress of each class, a 3-D view, each pipe with its photographs, plan and elevations."""
    from pipeprog_bringup.console import share_bar
    from pipeprog_bringup.report.page import report as write

    with share_bar("report") as show:
        target = write(folders, out, force, show, pdf)
    _say(f"Report: {target}")


@app.command(rich_help_panel="From results")
def view(
    folder: Annotated[Path, typer.Argument(help="Results of a survey.", metavar="DIR")],
    image: Annotated[
        Path | None,
        typer.Option("--image", help="Write a picture; this needs no display.", metavar="FILE.png"),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option("--mesh", help="Write the pipes as meshes for CAD and viewers.", metavar="FILE.glb|ply|obj"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the files that are named.")] = False,
) -> None:
    """Show cloud, pipes and cameras in a window; with --image or --mesh write a file and open none."""
    from pipeprog_bringup.view import display

    if image is not None:
        display.write_image(folder, image, force)
        _say(f"Picture: {image}")
    if mesh is not None:
        display.write_mesh(folder, mesh, force)
        _say(f"Meshes of the pipes: {mesh}")
    if image is None and mesh is None:
        display.show(folder)


@app.command(rich_help_panel="From results")
def export(
    folder: Annotated[Path, typer.Argument(help="Results of a survey.", metavar="DIR")],
    to: Annotated[
        list[str],
        typer.Option(
            "--to", help="Format; may be repeated: xlsx, csv, ifc, bcf, dxf, glb, laz, colmap.", metavar="FORMAT"
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the files; without, DIR/export.", metavar="FOLDER")
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option("--points", help="Control points (YAML): the site's coordinates.", metavar="POINTS.yaml"),
    ] = None,
    board: Annotated[
        Path | None, typer.Option("--board", help="Boards whose circles are control points.", metavar="BOARD.yaml")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files of an earlier export.")] = False,
) -> None:
    """Write the results for other programs: `pipeprog export out/demo --to xlsx --to csv`."""
    from pipeprog_bringup.export.formats import export as write
    from pipeprog_bringup.export.formats import site_alignment

    alignment, told = (None, []) if points is None else site_alignment(folder, points, board)
    for sentence in told:
        _say(sentence)
    for path in write(folder, to, out or folder / "export", force, alignment):
        _say(f"Written: {path}")


def main() -> None:
    """Entry point: exit 0 when done, 1 after a clear error, 2 after wrong usage, 130 after Ctrl-C."""
    from pipeprog_bringup.playback.node_processes import NodeFailure
    from pipeprog_camera.errors import InputError
    from pipeprog_camera.user_folders import provide_user_folders

    # As for Ctrl-C, what was started is ended and what was half written is removed.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        provide_user_folders()
        code = app(prog_name="pipeprog", standalone_mode=False)
    except (InputError, NodeFailure) as error:
        _fail(str(error))
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except click.ClickException as error:
        from typer.rich_utils import rich_format_error

        rich_format_error(error)
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        typer.secho("Interrupted: nothing was written.", fg=typer.colors.YELLOW, err=True)
        sys.exit(130)
    except BrokenPipeError:
        # The reader of our output has left (`pipeprog ... | head`).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        _fail(f"{error.filename or 'input or output'}: {error.strerror or error}")
    sys.exit(code or 0)


def _say(message: str) -> None:
    typer.echo(for_terminal(message))


def _fail(message: str) -> None:
    typer.secho(for_terminal(f"Error: {message}"), fg=typer.colors.RED, err=True)
    sys.exit(1)


def _note(message: str) -> None:
    typer.secho(for_terminal(f"Note: {message}"), fg=typer.colors.YELLOW, err=True)


if __name__ == "__main__":
    main()
