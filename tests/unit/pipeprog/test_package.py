# SPDX-License-Identifier: Apache-2.0
"""The plain Python package: what `pip install .` gives on a machine without ROS."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

if sys.version_info >= (3, 11):
    import tomllib
else:
    from pip._vendor import tomli as tomllib

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
NO_ROS = "import sys; sys.modules.update(dict.fromkeys(('rclpy', 'pipeprog_msgs', 'sensor_msgs', 'std_msgs')));"


def requirements(name: str) -> list[Requirement]:
    lines = (ROOT / name).read_text().splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this tree, built outside it."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE", "requirements-view.txt", "requirements-fleet.txt"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "src", folder / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-index", "--no-build-isolation", "."]
    subprocess.run(command, cwd=folder, check=True, timeout=200)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with the wheel in it; what pipeprog depends on is taken from the one that runs the tests."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder


def test_the_wheel_holds_every_file_of_the_packages(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    sources = [package for package in (ROOT / "src").iterdir() if (package / "setup.py").exists()]
    files = [path for package in sources for path in (package / package.name).rglob("*") if path.is_file()]
    expected = {
        str(path.relative_to(ROOT / "src" / path.relative_to(ROOT / "src").parts[0]))
        for path in files
        if "__pycache__" not in path.parts
    }
    assert held == expected


def test_it_works_in_a_fresh_environment(environment: Path, tmp_path: Path) -> None:
    boards = ROOT / "bags" / "demo.board.yaml"
    board = f"sys.argv = ['pipeprog', 'board', {str(boards)!r}, '--paper', 'A1', '--out', 'board.pdf']"
    code = f"{NO_ROS} import pipeprog; print(pipeprog.__file__); {board}; import pipeprog_bringup.cli as c; c.main()"
    command = [str(environment / "bin" / "python"), "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(str(environment))
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


def test_version_is_that_of_the_ros_packages() -> None:
    manifest = (ROOT / "src" / "pipeprog" / "package.xml").read_text()
    assert f"<version>{PROJECT['project']['version']}</version>" in manifest


def test_every_pin_lies_in_the_range_of_its_dependency() -> None:
    ranges = {requirement.name: requirement for requirement in map(Requirement, PROJECT["project"]["dependencies"])}
    pins = {requirement.name: requirement for requirement in requirements("requirements.txt")}
    assert set(ranges) == set(pins)
    for name, pin in pins.items():
        (version,) = (specifier.version for specifier in pin.specifier)
        assert version in ranges[name].specifier, name
        assert pin.extras == ranges[name].extras


def test_open3d_is_pinned_once() -> None:
    assert {str(requirement.specifier) for requirement in requirements("requirements-view.txt")} == {"==0.19.0"}


def test_pyproject_names_every_package_folder() -> None:
    folders = {f"src/{package.name}" for package in (ROOT / "src").iterdir() if (package / "setup.py").exists()}
    assert set(PROJECT["tool"]["setuptools"]["packages"]["find"]["where"]) == folders
    assert not [name for name in folders if not re.fullmatch(r"src/pipeprog(_\w+)?", name)]
