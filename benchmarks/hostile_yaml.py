# SPDX-License-Identifier: Apache-2.0
"""YAML and JSON that are damaged or made to do harm: each read and used, under limits.

    .venv/bin/python -m benchmarks.hostile_yaml [--tried 500] [--seed 0]

First the table of named cases (NAMED), which are unit tests too, then valid files (VALID) with values that do harm in
place of their own and with damaged bytes, until 500 YAML files were tried; then as many JSON files by half. Each is
read in a process of its own; what fails is a traceback, a death, over 20 s, over 2 GiB, or an error of several lines or
without the file's name. Writes results/hostile_yaml.json.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import random
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads do not survive a fork

from benchmarks.limited import Outcome, count_and_seed, try_files, write_tried
from benchmarks.recordings import ROOT
from pipeprog_bringup.console import print_progress, print_score
from pipeprog_bringup.footage.camera_file import read_camera_file
from pipeprog_bringup.recording.bag_folder import parts
from pipeprog_bringup.results.result_files import write_progress
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_bringup.results.scoring import score_files
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.product.product import product_of
from pipeprog_sfm.boards.board import layouts
from pipeprog_sfm.boards.board_file import load_board_file
from tests.fuzz.mutated_bytes import mutated

SECONDS, MEMORY = 20.0, 1 << 31
WHAT = "YAML (bills, boards, calibrations, rosbag2 metadata) and JSON (results, truth) that are damaged or do harm"
LONGEST = 600  # characters of an error, less the file's path: two values of 80 and their remedies

_CAMERA = """image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0.0, 0.0, 0.0, 0.0]}
"""
_METADATA = """rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  compression_mode: ""
  relative_file_paths: [part.mcap]
  duration: {nanoseconds: 1000000000}
"""
_PIPE = (
    '{"id": "p01", "start": [0, 0, 0], "end": [1.5, 0, 0], "radius": 0.05, "radius_sigma": null, "length": 1.5, '
    '"class": "DN100", "class_probability": 0.9, "visible_arc_deg": 90.0, "rmse": 0.001, "points": 9}'
)
_CLASS = '{"class": "DN100", "outer_radius": 0.05, "planned_m": 2.0, "installed_m": 1.5, "percent": 75.0}'
_RESULTS = (
    '{"frame_id": "map", "scale": {"source": "board", "sigma": 0.001}, "pipes": ['
    + _PIPE
    + '], "classes": ['
    + _CLASS
    + '], "runs": []}'
)
_TRUTH = '{"pipes": [{"id": "t1", "start": [0, 0, 0], "end": [1.5, 0, 0], "radius": 0.05}], "ignore": []}'
# Valid files by what they are; the name of a case ends with one of these.
VALID = {
    "boq.yaml": (ROOT / "bags" / "demo.boq.yaml").read_text(),
    "board.yaml": (ROOT / "bags" / "demo.board.yaml").read_text(),
    "camera.yaml": _CAMERA,
    "metadata.yaml": _METADATA,
    "pipes.json": _RESULTS,
    "truth.json": _TRUTH,
}


def kind_of(path: Path) -> str:
    """The key of VALID that a file is named by."""
    return next(kind for kind in VALID if path.name.endswith(kind))


def read_and_use(path: Path) -> None:
    """Reads a file as the command does, and prints, writes and compares what it holds."""
    _USES[kind_of(path)](path)


def _use_boq(path: Path) -> None:
    product = product_of([], load_boq(path))
    with contextlib.redirect_stdout(io.StringIO()):
        print_progress(product)
    write_progress(path.with_suffix(".csv"), product)


def _use_metadata(path: Path) -> None:
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    (folder / "part.mcap").touch()
    (folder / "metadata.yaml").unlink(missing_ok=True)
    (folder / "metadata.yaml").symlink_to(path)
    parts(folder)


def _use_results(path: Path) -> None:
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    for name in ("pipes.json", "run.json"):
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(path)
    results = read_results(folder)
    _ = results.colors, results.cylinders
    _score(folder / "pipes.json", _beside(path, "good.truth.json"))


def _use_truth(path: Path) -> None:
    _score(_beside(path, "good.pipes.json"), path)


def _score(pipes: Path, truth: Path) -> None:
    figures = score_files(pipes, truth)
    with contextlib.redirect_stdout(io.StringIO()):
        print_score(figures)


def _beside(path: Path, name: str) -> Path:
    """The valid file of that name in the folder of `path`."""
    good = path.parent / name
    if not good.exists():
        good.write_text(VALID[kind_of(good)])
    return good


_USES: dict[str, Callable[[Path], object]] = {
    "boq.yaml": _use_boq,
    "board.yaml": lambda path: layouts(load_board_file(path).boards),
    "camera.yaml": read_camera_file,
    "metadata.yaml": _use_metadata,
    "pipes.json": _use_results,
    "truth.json": _use_truth,
}


# Values that do harm where they stand.


def laughs(levels: int) -> str:
    """A mapping of lists, each of nine times the one before: 9^levels texts once written out."""
    rows = ["x0: &x0 [" + ", ".join(["lol"] * 9) + "]"]
    rows += [f"x{i}: &x{i} [" + ", ".join([f"*x{i - 1}"] * 9) + "]" for i in range(1, levels)]
    return "{" + ", ".join(rows) + "}"


DIGITS = "1" * 5000
YAML_VALUES = {
    "nothing": "~",
    "yes": "yes",
    "an empty list": "[]",
    "an empty mapping": "{}",
    "zero": "0",
    "minus one": "-1",
    "infinity": ".inf",
    "not a number": ".nan",
    "beyond doubles": "1.0e+400",
    "the largest double": "1.7e+308",
    "the smallest double": "5.0e-324",
    "10^400": "1" + 400 * "0",
    "5000 digits": DIGITS,
    "5000 digits in base 60": ":".join(["59"] * 1600),
    "a hexadecimal number of nothing": "0x_",
    "a binary number of nothing": "0b_",
    "an impossible date": "2001-99-99",
    "a date": "2001-01-01",
    "a time": "2001-01-01T25:61:61Z",
    "an integer that is none": "!!int x",
    "an integer of nothing": '!!int ""',
    "a yes that is none": "!!bool maybe",
    "a number that is none": "!!float x",
    "an object of Python": "!!python/object/apply:os.system ['false']",
    "binary data": "!!binary AAAA",
    "a set": "!!set {a, b}",
    "a NUL": '"a\\0b"',
    "an escape sequence": '"\\e[2J"',
    "a right-to-left override": '"a\\u202Eb"',
    "a long text": "x" * 60_000,
    "too long a text": "x" * 70_000,
    "markup": "'[/red]x'",
    "a formula in dollars": "'$\\frac{1}{$'",
    "a formula of a spreadsheet": "'=cmd|calc!A0'",
    "a template": "'{{ 7 * 7 }}'",
    "a page": "'<script>alert(1)</script>'",
    "a path upwards": "../../../etc/passwd",
    "an absolute path": "/etc/passwd",
    "a list of aliases": "[&a [" + "x, " * 900 + "], " + "*a, " * 900 + "]",
    "nested aliases": laughs(6),
    "a billion laughs": laughs(10),
    "an alias of itself": "&a [*a]",
    "an alias of nothing": "*none",
    "500 lists deep": "[" * 500 + "]" * 500,
    "a list of 100 000": "[" + "1, " * 100_000 + "]",
    "an open list": "[1, 2",
    "an open quote": '"open',
}
JSON_VALUES = {
    "nothing": "null",
    "true": "true",
    "an empty list": "[]",
    "an empty object": "{}",
    "a text": '"x"',
    "zero": "0",
    "minus one": "-1",
    "not a number": "NaN",
    "infinity": "Infinity",
    "beyond doubles": "1e400",
    "the largest double": "1.7e308",
    "the smallest double": "5e-324",
    "10^400": "1" + 400 * "0",
    "5000 digits": DIGITS,
    "a NUL": '"a\\u0000b"',
    "an escape sequence": '"\\u001b[2J"',
    "half a surrogate pair": '"\\ud800"',
    "a long text": '"' + "x" * 60_000 + '"',
    "markup": '"[/red]x"',
    "a formula in dollars": '"$\\\\frac{1}{$"',
    "500 lists deep": "[" * 500 + "]" * 500,
    "100 000 lists deep": "[" * 100_000,
    "a list of 100 000": "[" + "1, " * 100_000 + "1]",
    "3000 pipes": "[" + ", ".join([_PIPE] * 3000) + "]",
}
# Whole files, whatever they should be.
YAML_FILES = {
    "an empty file": b"",
    "a text": b"text",
    "a number": b"3",
    "5000 digits": DIGITS.encode(),
    "NULs": bytes(1000),
    "a list": b"- 1",
    "latin-1": "name: Gr\xf6\xdfe".encode("latin-1"),
    "UTF-16": "name: a".encode("utf-16"),
    "half surrogates": b"name: \xed\xa0\x80",
    "over-long UTF-8": b"name: \xc0\x80",
    "a million open brackets": b"[" * 1_000_000,
    "a million dashes": b"- " * 500_000,
    "a million question marks": b"? " * 500_000,
    "a million open braces": b"{a: " * 250_000,
    "deep indentation": "\n".join(" " * k + "a:" for k in range(1400)).encode(),
    "two documents": b"a: 1\n---\nb: 2\n",
    "250 000 documents": b"---\n" * 250_000,
    "90 000 tag directives": b"%TAG !a! x\n" * 90_000 + b"---\na",
    "80 000 anchors": b"".join(b"- &a%d x\n" % k for k in range(80_000)),
    "a foreign version": b"%YAML 3.0\n---\na: 1",
    "tabs": b"\ta:\n\t\tb: 1",
    "a key twice": b"a: 1\na: 2",
    "a list as key": b"? [1, 2]\n: 3",
    "a merge with a number": b"<<: 3",
    "a merge with itself": b"&a\n<<: *a",
    "a large file": b"#" * (5 << 20),
    "a line without end": b"classes: " + b"x" * 1_000_000,
}
_ROW = "  - {{name: c{0}, outer_radius_mm: {1}, planned_length_m: 1}}\n"
_CIRCLES = ", ".join(f"[{100 * (k % 150)}, {100 * (k // 150)}]" for k in range(20_000))
SPECIAL: dict[str, str] = {
    "30 000 classes.boq.yaml": "classes:\n" + "".join(f"- {{name: c{k}}}\n" for k in range(30_000)),
    "1000 classes.boq.yaml": "classes:\n" + "".join(_ROW.format(k, 10 + k) for k in range(1000)),
    "20 000 circles.board.yaml": f"boards: [{{name: A, circle_radius_mm: 40, centres_mm: [{_CIRCLES}]}}]",
    "100 000 marks.board.yaml": "marks: [" + "1, " * 100_000 + "]",
    "aliases at the top.boq.yaml": laughs(6),
    "aliases as keys.boq.yaml": "classes: [{? &a [x, x] : 1, ? *a : 2}]",
    "100 000 files.metadata.yaml": _METADATA.replace("part.mcap", ", ".join(f"p{k}.mcap" for k in range(100_000))),
    "a file twice.metadata.yaml": _METADATA.replace("part.mcap", "part.mcap, part.mcap"),
}


def _written(content: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(content)

    return write


def _linked(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def with_value(kind: str, value: str, place: int) -> str:
    """A valid file in which the value number `place` is replaced."""
    pattern = r"(?<=: )(?!\n)[^\s,\[\]{}][^,\[\]{}\n]*|(?<=[\[,] )[\d\-.]+" if kind.endswith("yaml") else _JSON_VALUE
    found = list(re.finditer(pattern, VALID[kind]))
    span = found[place % len(found)].span()
    return VALID[kind][: span[0]] + value + VALID[kind][span[1] :]


_JSON_VALUE = r'(?<=: )("[^"]*"|[\d.]+|null|\[[^\[\]]*\])|(?<=[\[ ])\d+(?=[,\]])'


def _named() -> dict[str, Callable[[Path], None]]:
    named = {name: _written(text.encode()) for name, text in SPECIAL.items()}
    kinds = [kind for kind in VALID if kind.endswith("yaml")]
    for number, (name, content) in enumerate(YAML_FILES.items()):
        named[f"{name}.{kinds[number % len(kinds)]}"] = _written(content)
    for number, (name, value) in enumerate(YAML_VALUES.items()):
        for step, kind in enumerate(kinds):
            named[f"{name}.{kind}"] = _written(with_value(kind, value, number + step).encode())
    for number, (name, value) in enumerate(JSON_VALUES.items()):
        for kind in ("pipes.json", "truth.json"):
            named[f"{name}.{kind}"] = _written(with_value(kind, value, number).encode())
    for kind in VALID:
        named[f"a pipe between processes.{kind}"] = lambda path: os.mkfifo(path)
        named[f"an endless device.{kind}"] = _linked("/dev/zero")
        named[f"a folder.{kind}"] = lambda path: path.mkdir()
        named[f"a link to itself.{kind}"] = lambda path: path.symlink_to(path)
    return named


NAMED = _named()


def changed(folder: Path, kinds: list[str], count: int, seed: int) -> Iterator[Path]:
    """Valid files with one to three values that do harm, or with damaged bytes."""
    rng = random.Random(seed)
    for number in range(count):
        kind = kinds[number % len(kinds)]
        values = list((YAML_VALUES if kind.endswith("yaml") else JSON_VALUES).values())
        if number % 2:
            content = mutated(VALID[kind].encode(), rng)
        else:
            content = with_value(kind, rng.choice(values), rng.randrange(1000)).encode()
            content = mutated(content, rng) if rng.random() < 0.3 else content
        path = folder / f"changed {number}.{kind}"
        path.write_bytes(content)
        yield path


def judged(path: Path, outcome: Outcome) -> str:
    """What is wrong with what became of a file; empty where nothing is."""
    if outcome.kind == "done":
        return ""
    if outcome.kind != "refused":
        return f"{outcome.kind}: {outcome.text}"
    # Results and recordings are folders, whose files the error names.
    names = (str(path), str(path.with_suffix("")))
    if not any(name in outcome.text for name in names) or "\n" in outcome.text:
        return f"an error that does not name the file in one line: {outcome.text[:200]}"
    if len(outcome.text) > LONGEST + 3 * len(str(path)):
        return f"an error of {len(outcome.text)} characters"
    return ""


def main() -> None:
    """Tries the files and writes what failed."""
    arguments = count_and_seed(__doc__)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind in VALID:  # imports what the processes share
            read_and_use(_beside(folder / "x", f"good.{kind}"))
        files = _tried(folder, arguments.tried, arguments.seed)
        tried = try_files(files, read_and_use, judged, SECONDS, MEMORY)
    write_tried("hostile_yaml", WHAT, arguments, tried)


def _tried(folder: Path, count: int, seed: int) -> Iterator[Path]:
    """The named files, then changed ones until `count` are YAML and half as many JSON."""
    for name, make in NAMED.items():
        make(folder / name)
        yield folder / name
    for suffix, wanted in (("yaml", count), ("json", count // 2)):
        kinds = [kind for kind in VALID if kind.endswith(suffix)]
        known = sum(name.endswith(suffix) for name in NAMED)
        yield from itertools.islice(changed(folder, kinds, max(0, wanted - known), seed), wanted)


if __name__ == "__main__":
    main()
