# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipeprog_bringup.results.atomic_output import JOURNAL, OutputFolder, left_behind, output_file
from pipeprog_camera.errors import InputError


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def run(folder: Path, files: dict[str, str], force: bool = False) -> None:
    with OutputFolder(folder, force) as output:
        for name, text in files.items():
            output.file(name).write_text(text)
        output.file("run.json").write_text(json.dumps({"files": [*files, "run.json"]}))


def fail(folder: Path, error: BaseException, force: bool = False) -> None:
    with OutputFolder(folder, force) as output:
        output.file("pipes.json").write_text("{")
        raise error


def fail_in_one_file(path: Path) -> None:
    with output_file(path, force=True) as temporary:
        temporary.write_text("half")
        raise RuntimeError("stop")


def test_files_appear_when_the_run_has_ended(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "results"
    with OutputFolder(folder) as output:
        output.file("pipes.json").write_text("{}")
        assert not (folder / "pipes.json").exists()
    assert names(folder) == ["pipes.json"]


def test_files_in_folders_come_and_go_with_the_run(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    with OutputFolder(folder) as output:
        output.file("colmap").mkdir()
        output.file("colmap/points.txt").write_text("old")
        output.file("run.json").write_text(json.dumps({"files": output.names()}))
        assert output.names() == ["colmap/points.txt", "run.json"]
    assert (folder / "colmap" / "points.txt").read_text() == "old"
    with OutputFolder(folder, force=True) as output:
        output.file("colmap").mkdir()
        output.file("colmap/points.txt").write_text("new")
    assert (folder / "colmap" / "points.txt").read_text() == "new"
    (folder / "run.json").write_text(json.dumps({"files": ["colmap/points.txt", "../mine.txt", "/mine.txt"]}))
    (tmp_path / "mine.txt").write_text("keep")
    run(folder, {"pipes.json": "new"}, force=True)
    assert names(folder) == ["pipes.json", "run.json"]
    assert (tmp_path / "mine.txt").exists()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, InputError])
def test_a_run_that_fails_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    folder = tmp_path / "deep" / "results"
    with pytest.raises(error):
        fail(folder, error("stop"))
    assert names(tmp_path) == []


def test_a_folder_in_use_needs_force(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="--force"):
        run(tmp_path, {"pipes.json": "new"})
    run(tmp_path, {"pipes.json": "new"}, force=True)
    assert names(tmp_path) == ["mine.txt", "pipes.json", "run.json"]
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_force_replaces_the_earlier_run_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    run(folder, {"pipes.json": "old", "trajectory.tum": "old"})
    (folder / "notes.txt").write_text("mine")
    (folder / "cloud.ply").write_text("not of that run")
    run(folder, {"pipes.json": "new"}, force=True)
    assert names(folder) == ["cloud.ply", "notes.txt", "pipes.json", "run.json"]
    assert (folder / "pipes.json").read_text() == "new"


def test_force_keeps_the_earlier_run_when_the_new_one_fails(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    run(folder, {"pipes.json": "old", "trajectory.tum": "old"})
    with pytest.raises(ValueError, match="stop"):
        fail(folder, ValueError("stop"), force=True)
    assert names(folder) == ["pipes.json", "run.json", "trajectory.tum"]
    assert (folder / "pipes.json").read_text() == "old"


def test_a_list_of_files_cannot_reach_outside_the_folder(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("keep")
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps({"files": ["../precious", 3, "/etc/passwd"]}))
    run(folder, {"pipes.json": "new"}, force=True)
    assert (tmp_path / "precious").read_text() == "keep"


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with OutputFolder(tmp_path), pytest.raises(InputError, match="another run"):
        OutputFolder(tmp_path, force=True).__enter__()


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".pipeprog-left").mkdir()
    (tmp_path / ".pipeprog-left" / "pipes.json").write_text("{")
    run(tmp_path, {"pipes.json": "new"})
    assert names(tmp_path) == ["pipes.json", "run.json"]


def test_a_place_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for place in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/results")):
        with pytest.raises(InputError, match=str(place)), OutputFolder(place):
            pass


def test_a_full_disk_is_reported_as_such(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no space left"), OutputFolder(tmp_path / "results"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert names(tmp_path) == []


def test_an_interrupt_between_the_renames_waits_for_their_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = os.replace

    def interrupted(source: Path, target: Path) -> None:
        signal.raise_signal(signal.SIGINT)
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "results", {"a": "1", "b": "2"})
    assert names(tmp_path / "results") == ["a", "b", "run.json"]


def test_a_killed_run_leaves_no_final_name(tmp_path: Path) -> None:
    code = (
        "import sys, time, pathlib\n"
        "from pipeprog_bringup.results.atomic_output import OutputFolder\n"
        "with OutputFolder(pathlib.Path(sys.argv[1])) as output:\n"
        "    output.file('pipes.json').write_text('{')\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "results")], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    process.kill()
    process.wait()
    assert not (tmp_path / "results" / "pipes.json").exists()
    run(tmp_path / "results", {"pipes.json": "new"})
    assert names(tmp_path / "results") == ["pipes.json", "run.json"]


def test_one_file_is_replaced_only_by_a_whole_one(tmp_path: Path) -> None:
    path = tmp_path / "below" / "bag.mcap"
    with output_file(path) as temporary:
        temporary.write_text("first")
    with pytest.raises(InputError, match="exists"), output_file(path):
        pass
    with pytest.raises(RuntimeError, match="stop"):
        fail_in_one_file(path)
    assert path.read_text() == "first"
    assert names(path.parent) == ["bag.mcap"]
    with pytest.raises(InputError, match="is a folder"), output_file(tmp_path):
        pass


def test_what_a_killed_run_has_left_is_gone_on_with_and_its_journal_is_no_result(tmp_path: Path) -> None:
    stage = tmp_path / "out" / ".pipeprog-left"
    (stage / JOURNAL).mkdir(parents=True)
    (stage / JOURNAL / "notes").write_text("here")
    assert list(left_behind(tmp_path / "out")) == [stage]
    with OutputFolder(tmp_path / "out", left=stage) as folder:
        assert folder.file(f"{JOURNAL}/notes").read_text() == "here"
        assert not list(left_behind(tmp_path / "out"))  # it is being written to
        folder.file("run.json").write_text("{}")
        assert folder.names() == ["run.json"]
    assert [file.name for file in (tmp_path / "out").rglob("*")] == ["run.json"]
