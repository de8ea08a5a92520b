# SPDX-License-Identifier: Apache-2.0
"""`pipeprog replay`: a recording through the node graph, frame by frame, without losing one."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pipeprog_bringup.playback.node_processes import NODE_MODULES, Graph
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_bringup.playback.scratch import check_room, scratch_folder
from pipeprog_bringup.playback.session import Session, State
from pipeprog_bringup.playback.survey_writer import record_keyframes, record_survey, seen_by, write_survey
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.recording_check import first_look
from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.atomic_output import OutputFolder
from pipeprog_bringup.results.nothing_found import why_nothing_was_found
from pipeprog_bringup.results.plan_file import write_plan
from pipeprog_bringup.results.plan_place import why_no_place_is_planned
from pipeprog_bringup.results.setting_overrides import as_parameters, effective, given_names
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import BillOfQuantities, load_boq
from pipeprog_detect.product.product import Product
from pipeprog_node.messages import points_from_cloud
from pipeprog_node.ros_context import ros_context
from pipeprog_sfm.alignment.map_file import MAP_FILE, read_map
from pipeprog_sfm.alignment.survey_map import SurveyMap
from pipeprog_sfm.boards.board_file import BoardFile, load_board_file

FOCAL_SIGMA = "sfm.calibration.focal_sigma"
_GIVE_POINTS = "is it in site coordinates? `pipeprog export --points` compares them there"
GUESSED_DISTORTION = 0.1  # standard deviation of k1 where no distortion is known: lenses of phones have up to 0.2


@dataclasses.dataclass(frozen=True)
class Request:
    """What to replay."""

    bag: Path
    boq: Path
    out: Path
    board: Path | None = None
    rate: float | None = None
    overrides: Sequence[str] = ()
    force: bool = False
    image_topic: str | None = None
    camera_info_topic: str | None = None
    odometry_topic: str | None = None
    imu_topic: str | None = None
    with_cloud: bool = True
    reference: Path | None = None
    rig: bool = False


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of a replay; `notes` and `losses` are sentences for the user on plan and recording."""

    product: Product
    frames: int
    keyframes: int
    registered: int
    notes: list[str]
    losses: list[str]


@dataclasses.dataclass(frozen=True)
class _Inputs:
    """What a request names, read and checked."""

    bag: Bag
    boq: BillOfQuantities
    board_file: BoardFile
    configs: dict[str, Any]  # settings of each node
    reference: SurveyMap | None = None


def replay(
    request: Request,
    report: Callable[[State], None],
    tell: Callable[[str], None],
    modules: dict[str, str] = NODE_MODULES,
) -> Outcome:
    """Run the node graph on a recording and write its results.

    `report` is called with where it stands, `tell` with sentences on the recording, before the nodes start.
    Raises InputError for what the user can mend and NodeFailure when a node dies, hangs or fails; either leaves no
    process and no file behind.
    """
    check_room(request.bag)
    inputs = _read(request)
    with OutputFolder(request.out, request.force) as folder, scratch_folder() as scratch:
        found = first_look(inputs.bag, inputs.board_file, inputs.configs["sfm"].board, inputs.reference is not None)
        for sentence in found.notes:
            tell(sentence)
        if found.faults:
            raise InputError("; ".join(found.faults))
        parameters = _parameters(request, inputs.configs, folder.file("colmap"))
        parameters["frames"]["cameras"] = " ".join(camera.frame_id for camera in inputs.bag.rig)
        session = Session(inputs.bag, request.rate, report)
        with private_network(scratch), Graph(parameters, scratch, modules) as graph, ros_context():
            survey, status = session.run(graph)
        with folder.file("out.mcap").open("wb") as stream, BagWriter(stream) as recording:
            recording.describe(_described(request))
            record_survey(recording, survey, status)
            cameras = record_keyframes(recording, inputs.bag, session.log, survey)
        started = time.monotonic()
        seen = seen_by(survey, cameras, inputs.boq.pipes)
        product = write_survey(folder, survey, session.log, seen, request.with_cloud, inputs.reference)
        points = points_from_cloud(survey.cloud)[0]
        outcome = Outcome(
            product=product,
            frames=session.log.considered,
            keyframes=session.log.chosen,
            registered=status.keyframes_registered,
            notes=[
                *inputs.boq.notes,
                *inputs.bag.notes,
                *filter(None, [status.calibration, status.message]),
                *why_nothing_was_found(product, points, inputs.boq),
                *why_no_place_is_planned(inputs.boq.pipes, points, _GIVE_POINTS),
            ],
            losses=inputs.bag.losses + session.log.faults(),
        )
        if inputs.boq.pipes:
            write_plan(folder.file("plan.json"), inputs.boq.pipes)
        result_files.write_config(folder.file("config.yaml"), _settings(request, inputs))
        timings = {**session.timings, "write": time.monotonic() - started}
        result_files.write_run(folder, _facts(request, inputs, outcome, timings))
    return outcome


def _read(request: Request) -> _Inputs:
    """Read what the request names; raises InputError where something of it cannot be used."""
    if request.rig and (request.image_topic or request.camera_info_topic):
        raise InputError("--rig takes all cameras: leave --image-topic and --camera-info-topic out")
    motion = request.odometry_topic, request.imu_topic
    if request.rig:
        bag = Bag.open_rig(request.bag, *motion)
    else:
        bag = Bag.open(request.bag, request.image_topic, request.camera_info_topic, *motion)
    boq = load_boq(request.boq)
    board_file = load_board_file(request.board) if request.board else BoardFile()
    if request.rate is not None and not request.rate > 0:
        raise InputError(f"--rate {request.rate:g}: give a factor above zero, 1 for real time")
    if "frames.lockstep" in given_names(request.overrides):
        raise InputError("--set frames.lockstep: a replay is always in lockstep, or it would lose frames")
    configs = effective([*told_by(bag, given_names(request.overrides)), *request.overrides])
    configs["frames"] = dataclasses.replace(configs["frames"], lockstep=True)
    return _Inputs(bag, boq, board_file, configs, read_map(request.reference / MAP_FILE) if request.reference else None)


def told_by(bag: Bag, given: set[str]) -> list[str]:
    """Settings that a recording tells of its camera, those that the user has given left out."""
    told: dict[str, float] = {}
    if bag.readout is not None:
        told["sfm.readout"] = bag.readout
    if bag.focal_sigma is not None:
        told |= {FOCAL_SIGMA: bag.focal_sigma, "sfm.calibration.distortion_sigma": GUESSED_DISTORTION}
    return [f"{name}={value!r}" for name, value in told.items() if name not in given]


def _parameters(request: Request, configs: dict[str, Any], colmap: Path) -> dict[str, dict[str, Any]]:
    """The ROS parameters of each node: its settings, and the files that it reads or writes."""
    parameters = as_parameters(configs)
    board = str(request.board.resolve()) if request.board else ""
    reference = str((request.reference / MAP_FILE).resolve()) if request.reference else ""
    parameters["sfm"] |= {"lockstep": True, "board": board, "colmap": str(colmap.resolve()), "intermediate": False}
    parameters["sfm"]["reference"] = reference
    parameters["detect"] |= {"boq": str(request.boq.resolve()), "intermediate": False}
    return parameters


def _settings(request: Request, inputs: _Inputs) -> dict[str, Any]:
    """The content of config.yaml."""
    return {
        **{node: dataclasses.asdict(config) for node, config in inputs.configs.items()},
        "boq": result_files.boq_entries(inputs.boq),
        "boards": [board.name for board in inputs.board_file.boards],
        "replay": {
            "bag": str(request.bag),
            "image_topic": inputs.bag.image_topic,
            "camera_info_topic": inputs.bag.camera_info_topic,
            "rig": [camera.image_topic for camera in inputs.bag.rig],
            "motion_topics": inputs.bag.motion_topics,
            "rate": request.rate,
            **({"reference": str(request.reference)} if request.reference else {}),
        },
    }


def _described(request: Request) -> dict[str, str]:
    """The metadata record of out.mcap; a site goes by the name of its bill of quantities."""
    version = result_files.package_version("pipeprog") or "unknown"
    return {
        "site": request.boq.stem,
        "survey": request.out.resolve().name,
        "bag": request.bag.name,
        "pipeprog": version,
    }


def _facts(request: Request, inputs: _Inputs, outcome: Outcome, timings: dict[str, float]) -> dict[str, Any]:
    """What run.json holds of this run, besides versions and files."""
    return {
        "command": "replay",
        "bag": str(request.bag.resolve()),
        "frames_in_bag": inputs.bag.image_count,
        "frames_considered": outcome.frames,
        "keyframes": outcome.keyframes,
        "registered": outcome.registered,
        "notes": outcome.notes,
        "losses": outcome.losses,
        "seeds": {node: config.seed for node, config in inputs.configs.items() if hasattr(config, "seed")},
        "timings_s": timings,
    }
