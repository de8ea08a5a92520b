# SPDX-License-Identifier: Apache-2.0
"""What the documents name is there: files, modules, headings, commands with their options, settings."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import shlex
from pathlib import Path

import click
import numpy as np
import pytest
import typer

from pipeprog_bringup.cli import app
from pipeprog_bringup.results.result_files import FRAME_COLUMNS
from pipeprog_bringup.results.scored_files import Result, Segment, Truth
from pipeprog_bringup.results.scoring import score
from pipeprog_bringup.results.setting_overrides import effective
from pipeprog_bringup.results.truth_alignment import align
from pipeprog_camera.errors import InputError

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "bags/README.md", "benchmarks/README.md")),
]
FOLDERS = ("src", "docs", "tests", "bags", "benchmarks", "setup", "examples")
# In place of what a command line leaves to the reader: DIR [DIR ...], BOARD.yaml.
OPTIONAL = re.compile(r"\[[^]]*\]")


def ids(path: Path) -> str:
    return str(path.relative_to(ROOT))


def without_code(text: str) -> str:
    return re.sub(r"```.*?```", "", text, flags=re.DOTALL)


def in_code(text: str) -> list[str]:
    """Inline code and the lines of code blocks."""
    blocks = re.findall(r"```[^\n]*\n(.*?)```", text, re.DOTALL)
    inline = re.findall(r"`([^`\n]+)`", without_code(text))
    lines = [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return inline + lines


def anchors(path: Path) -> set[str]:
    """What GitHub makes of the headings of a document."""
    headings = re.findall(r"^#+ (.*)$", without_code(path.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(path: Path, text: str) -> list[str]:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", without_code(text)):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    return broken


def missing_files(text: str) -> list[str]:
    names = [word for code in in_code(text) for word in re.findall(r"[\w./-]+", code)]
    paths = [name.rstrip("./") for name in names if name.split("/")[0] in FOLDERS and "/" in name.rstrip("./")]
    return [path for path in paths if not (ROOT / path).exists() and "_*" not in path]


def missing_modules(text: str) -> list[str]:
    """Dotted names of our packages that are neither a module nor something in one."""
    names = re.findall(r"\b(?:pipeprog_\w+|benchmarks)(?:\.\w+)+", "\n".join(in_code(text)))
    return [name for name in names if not (name.split(".")[-1].isupper() or is_there(name))]


def is_there(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    module, _, attribute = name.rpartition(".")
    try:
        if importlib.util.find_spec(name) is not None:
            return True
    except ModuleNotFoundError:
        pass
    try:
        return importlib.util.find_spec(module) is not None and hasattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError:
        return False


def commands(text: str) -> list[list[str]]:
    """Arguments of each `pipeprog` command line; a word of capitals with a comment behind it ends there."""
    found = []
    for code in in_code(text):
        match = re.match(r"(?:\$ )?(?:\.venv/bin/)?pipeprog\s+(.+)", code.split("  #")[0])
        if match:
            found.append(shlex.split(OPTIONAL.sub("", match.group(1))))
    return found


def fault(arguments: list[str]) -> str:
    """Why a command line is refused; empty where it is not. One without arguments only names its command."""
    group = typer.main.get_command(app)
    assert isinstance(group, click.Group)
    name, rest = arguments[0], arguments[1:]
    if name.startswith("-"):
        return "" if name in ("--help", "--version") else f"no option {name}"
    if name not in group.commands:
        return f"no command {name}"
    if not rest or rest == ["--help"]:
        return ""
    try:
        context = group.commands[name].make_context(name, rest)
        effective(context.params.get("overrides") or ())
    except click.ClickException as error:
        return error.format_message()
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("path", DOCUMENTS, ids=ids)
def test_links_lead_somewhere(path: Path) -> None:
    assert broken_links(path, path.read_text()) == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=ids)
def test_files_and_modules_that_are_named_exist(path: Path) -> None:
    text = path.read_text()
    assert missing_files(text) + missing_modules(text) == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=ids)
def test_command_lines_are_understood(path: Path) -> None:
    text = path.read_text()
    assert {" ".join(line): fault(line) for line in commands(text) if fault(line)} == {}
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = [match.group(1) for code in in_code(text) if (match := re.match(r"make ([a-z]+)", code))]
    assert [target for target in named if target not in targets] == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=ids)
def test_settings_that_are_named_exist(path: Path) -> None:
    parameters = (ROOT / "docs" / "parameters.md").read_text()
    known = {
        f"{node.split(chr(10))[0]}.{name}"
        for node in parameters.split("\n## ")[1:]
        for name in re.findall(r"^\| `([\w.]+)`", node, re.MULTILINE)
    }
    named = [re.match(r"(?:--set )?((?:frames|sfm|detect)\.(?!csv)[\w.]+)", code) for code in in_code(path.read_text())]
    assert [match.group(1) for match in named if match and match.group(1) not in known] == []


def test_every_package_and_room_is_in_the_architecture() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    packages = [path.parent for path in (ROOT / "src").glob("*/package.xml")]
    rooms = [path.parent for package in packages for path in package.glob(f"{package.name}/*/__init__.py")]
    named = [f"| `{package.name}` |" for package in packages] + [f"`{room.name}/`" for room in rooms]
    assert [name for name in named if name not in text] == []


def properties(schema: object) -> set[str]:
    """Names of the fields that a JSON schema describes, at all levels."""
    if isinstance(schema, list):
        return set().union(*map(properties, schema))
    if not isinstance(schema, dict):
        return set()
    own = set(schema["properties"]) if "required" in schema else set()
    return own.union(*map(properties, schema.values()))


def keys(content: object) -> set[str]:
    if isinstance(content, list):
        return set().union(*map(keys, content))
    return set(content).union(*map(keys, content.values())) if isinstance(content, dict) else set()


def test_every_field_of_the_results_is_described() -> None:
    pipe = Segment(np.zeros(3), np.ones(3), 0.05, 1.7, "p01", "DN100")
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1:, :3, 3] = np.eye(3)
    figures = score(Result((pipe,), {"DN100": 0.05}), Truth((pipe,), (), poses), align(poses, poses))
    fields = properties(json.loads((ROOT / "docs" / "pipes.schema.json").read_text())) | keys(figures)
    told = set(re.findall(r"\w+", " ".join(in_code((ROOT / "docs" / "files.md").read_text()))))
    assert {*fields, *FRAME_COLUMNS} - told == set()


def test_what_is_not_there_is_noticed() -> None:
    text = "[a](nowhere.md) [b](../README.md#no-heading) `src/nothing.py` `pipeprog_sfm.nothing` `benchmarks.nothing`"
    assert broken_links(ROOT / "docs" / "method.md", text) == ["nowhere.md", "../README.md#no-heading"]
    assert missing_files(text) == ["src/nothing.py"]
    assert missing_modules(text) == ["pipeprog_sfm.nothing", "benchmarks.nothing"]
    wrong = [
        "pipeprog fly",
        "pipeprog replay BAG --boq B --out D --wings",
        "pipeprog score A",
        "pipeprog detect C --boq B",
    ]
    assert all(fault(commands(f"`{line}`")[0]) for line in wrong)
    assert not fault(commands("`pipeprog report DIR [DIR ...] --out REPORT`")[0])
