# SPDX-License-Identifier: Apache-2.0
"""What all commands have in common: help with examples, completion, progress in files, words after Ctrl-C."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import click
import numpy as np
import pytest
import typer

from pipeprog_bringup import cli, console
from pipeprog_bringup.commands import speech
from pipeprog_bringup.playback.session import State
from pipeprog_bringup.results.nothing_found import why_nothing_was_found
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.product import product_of
from pipeprog_detect.types import Cylinder, Pipe

COMMANDS = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
BOQ = BillOfQuantities.of_radii({"DN65": 0.0365})


@pytest.mark.parametrize("name", COMMANDS)
def test_every_argument_and_option_has_a_help_text_with_an_example(name: str) -> None:
    command = COMMANDS[name]
    for parameter in command.params:
        assert parameter.help, parameter.name
        if not getattr(parameter, "is_flag", False):
            assert "Example: `" in parameter.help, parameter.name
    assert f"`pipeprog {name} " in command.help


def test_arguments_are_explained_on_the_screen(capsys: pytest.CaptureFixture[str]) -> None:
    COMMANDS["replay"].get_help(click.Context(COMMANDS["replay"]))
    assert "rosbag2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "expected"), [("pipeprog re", ["replay", "report"]), ("pipeprog export DIR --to x", ["xlsx"])]
)
def test_shells_complete_commands_and_values(
    words: str, expected: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_PIPEPROG_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    monkeypatch.setattr(sys, "argv", ["pipeprog"])
    with pytest.raises(SystemExit):
        cli.app(prog_name="pipeprog", standalone_mode=False)
    assert capsys.readouterr().out.split() == expected


@pytest.mark.parametrize(
    ("words", "function", "left"),
    [
        (["detect", "a.ply", "--boq", "b.yaml"], "detect_cloud.detect_file", "nothing was written"),
        (["patrol", "a.yaml"], "patrol.conduct.conduct", "what there is of the survey was kept"),
        (
            ["simulate-patrol", "a.mcap", "--boq", "b.yaml"],
            "simulated_patrol.simulate_patrol",
            "what there is of the survey was kept",
        ),
    ],
)
def test_after_ctrl_c_it_says_what_was_written(
    words: list[str], function: str, left: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"pipeprog_bringup.{function}", interrupted)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["pipeprog", *words, "--out", "out"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 130
    assert capsys.readouterr().err.endswith(f"Interrupted: {left}.\n")


def test_a_file_gets_a_line_for_each_stage_and_one_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, clock = io.StringIO(), 0.0
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("time.monotonic", lambda: clock)
    with console.replay_bars() as tell:
        for second in range(25):
            clock = 100.0 + second
            tell(State("choosing keyframes" if second < 24 else "reconstructing", 65, second, second // 2, 0))
    lines = stream.getvalue().splitlines()
    assert len(lines) == 4
    assert lines[0] == "replay: choosing keyframes, 0 of 65 frames considered, 0 of 0 keyframes registered"
    assert lines[-1].startswith("replay: reconstructing, 24 of 65 frames")


def test_quiet_shows_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    with console.replay_bars(True) as tell, console.share_bar("detect", True) as report:
        tell(State("choosing keyframes", 65, 1, 1, 0))
        report(0.5, "candidates")
    assert capsys.readouterr() == ("", "")


def test_results_are_told_as_json_and_by_their_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "pipes.json").write_text('{"pipes": []}')
    (tmp_path / "cloud.ply").write_bytes(bytes(2_000_000))
    (tmp_path / "mine.bin").write_bytes(bytes(9_000_000))
    (tmp_path / "run.json").write_text(json.dumps({"files": ["cloud.ply", "pipes.json", "run.json"], "notes": ["x"]}))
    speech.say_results(tmp_path)
    assert json.loads(capsys.readouterr().out) == {"folder": str(tmp_path), "notes": ["x"], "losses": [], "pipes": []}
    speech.say_sizes(tmp_path)
    assert capsys.readouterr().out == f"2.0 MB in {tmp_path} (cloud.ply 2.0, run.json 0.0, pipes.json 0.0)\n"


def pipe_of(radius: float, class_name: str | None, probability: float = 0.0) -> Pipe:
    cylinder = Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), radius)
    return Pipe("p01", cylinder, 1e-4, class_name, probability, 2.0, 1e-3, 100, class_name or "")


@pytest.mark.parametrize(
    ("scale", "step", "expected"),
    [
        (1000.0, 0.01, "1950 m wide: is it in another unit"),
        (1.0, 0.1, "100 mm apart, and the thinnest planned pipe has an outer radius of 36.5 mm"),
        (1.0, 0.02, "no surface of the cloud is round along a straight line"),
    ],
)
def test_no_pipes_have_a_reason_and_a_remedy(scale: float, step: float, expected: str) -> None:
    grid = np.arange(0.0, 2.0, step)
    wall = scale * np.stack([*map(np.ravel, np.meshgrid(grid, grid)), np.zeros(len(grid) ** 2)], axis=1)
    (told,) = why_nothing_was_found(product_of([], BOQ), wall, BOQ)
    assert told.startswith("no pipes were found: ")
    assert expected in told


def test_pipes_of_no_planned_class_are_told_with_both_radii() -> None:
    cloud = np.zeros((1, 3))
    (told,) = why_nothing_was_found(product_of([pipe_of(0.06, None)], BOQ), cloud, BOQ)
    assert "their outer radii are 60.0 mm, those of the bill 36.5 mm" in told
    assert why_nothing_was_found(product_of([pipe_of(0.0365, "DN65", 1.0)], BOQ), cloud, BOQ) == []


def test_pipes_between_two_planned_classes_are_told_as_such() -> None:
    near = BillOfQuantities.of_radii({"a": 0.0575, "b": 0.0576})
    product = product_of([pipe_of(0.0575, None, 0.51)], near)
    (told,) = why_nothing_was_found(product, np.zeros((1, 3)), near)
    assert told.startswith("1 pipes were found, none surely of one class: 1 may be of either of two planned ones")
    assert "the bill of this site" not in told
