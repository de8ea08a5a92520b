# SPDX-License-Identifier: Apache-2.0
"""The rules that hold the house up (docs/architecture.md), read from the sources."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(path.parent for path in (ROOT / "src").glob("*/package.xml"))
PYTHON_PACKAGES = [package for package in PACKAGES if (package / "setup.py").exists()]
MODULES = [path for package in PYTHON_PACKAGES for path in sorted((package / package.name).rglob("*.py"))]

# Who may import whom; every package may use itself and pipeprog_camera.
CORES = {"pipeprog_frames", "pipeprog_sfm", "pipeprog_detect"}
ALLOWED = {
    "pipeprog_camera": set(),
    "pipeprog_node": {"pipeprog_msgs"},
    **{core: set() for core in CORES},
    "pipeprog_bringup": {*CORES, "pipeprog_node", "pipeprog_msgs"},
    "pipeprog": {*CORES, "pipeprog_bringup"},
}
ALLOWED_IN_NODES = {"pipeprog_node", "pipeprog_msgs"}
# The modules beside the cores' node.py that speak ROS.
GLUE = {
    "pipeprog_node": {
        "parameters",
        "camera_transforms",
        "qos",
        "diagnostics",
        "discovery",
        "finish",
        "intake",
        "keyframe_input",
        "messages",
        "main",
        *{"header", "images", "keyframes", "maps", "motion"},  # the room received
        "renewal",
        "retirement_input",
        "ros_context",
        "worker",
    },
    "pipeprog_bringup": {
        *{"session", "connections", "player", "listener", "survey_writer", "outline_marker"},
        *{"simulated_robot", "simulated_patrol"},
        *{"node", "conducted_survey", "passage", "map_listener", "robot_input", "survey_output", "missing_input"},
        *{"survey_client", "conduct", "alignment_result", "waiting_client", "progress", "takeover"},
    },
}
# Inside a package: which folder may import which; modules beside node.py may import all of them,
# and all may import config.py, threads.py and types.py.
FOLDERS = {
    "pipeprog_node": {"processes": set(), "received": {"messages", "intake"}},
    "pipeprog_sfm": {
        "features": set(),
        "model": {"features"},
        "sparse": {"features", "model"},
        "boards": set(),
        "metric": {"boards"},
        "dense": set(),
        "calibration": {"boards"},
        "alignment": {"features", "model", "sparse", "boards"},
    },
    "pipeprog_detect": {
        "cloud": set(),
        "silhouette": set(),
        "refinement": {"silhouette"},
        "plan": set(),
        "product": {"plan"},
        "verification": {"cloud", "silhouette", "refinement", "product"},
        "thin": {"cloud", "silhouette", "refinement", "product", "verification"},
        "coverage": {"cloud", "silhouette", "product", "thin"},
        "look": {"silhouette", "product"},
    },
    "pipeprog_bringup": {
        "recording": set(),
        "clouds": set(),
        "footage": set(),
        "results": {"clouds"},
        "export": {"recording", "results"},
        "comparison": {"recording", "results"},
        "report": {"recording", "results", "comparison"},
        "view": {"report", "results"},
        "fleet": {"report", "results"},
        "playback": {"recording", "results"},
        "commands": {  # as thin as they are, they stand above all
            *("playback", "view", "export", "report", "results", "replay", "detect_cloud", "ingest", "survey_fleet"),
            *("console", "footage", "plane_from_keyframe", "recording", "recording_check", "comparison", "patrol"),
            *("calibrate", "simulated_patrol", "access_policy"),
        },
        "survey": {"playback", "recording", "results", "comparison"},
        "patrol": {"results"},
    },
}
LICENCE = "# SPDX-License-Identifier: Apache-2.0"
SHARED = {"config", "threads", "types"}
ROS = re.compile(r"rclpy|.*_msgs|.*_interfaces|launch(_ros)?|tf2_ros|ament_index_python")

# Import name -> dependency in package.xml; None: no rosdep key, requirements.txt installs it.
DEPENDENCIES = {
    "cv2": "python3-opencv",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "jinja2": "python3-jinja2",
    "PIL": "python3-pil",
    "rich": "python3-rich",
    "scipy": "python3-scipy",
    "sklearn": "python3-sklearn",
    "typer": "python3-typer",
    "yaml": "python3-yaml",
    "click": None,
    "laspy": None,
    "lazrs": None,
    "lz4": None,
    "mcap": None,
    "mcap_ros2": None,
    "ezdxf": None,
    "av": None,
    "ifcopenshell": None,
    "open3d": None,
    "openpyxl": None,
    "dask": None,
    "distributed": None,
    "fsspec": None,
    "psutil": None,
    "plyfile": None,
    "pye57": None,
    "pycolmap": None,
    "lzf": None,
    "xlsxwriter": None,
    "zstandard": None,
}


def imports(path: Path) -> set[str]:
    """Top-level names of the absolute imports of a file, those inside functions included."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


def owner(path: Path) -> str:
    return path.relative_to(ROOT / "src").parts[0]


def ids(path: Path) -> str:
    return str(path.relative_to(ROOT / "src"))


def knows_ros(path: Path) -> bool:
    """Whether a module may use ROS: the node of a core, and the glue."""
    package = owner(path)
    return (package in CORES and path.stem == "node") or path.stem in GLUE.get(package, ())


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_only_nodes_and_their_glue_know_ros(path: Path) -> None:
    if not knows_ros(path):
        assert not {name for name in imports(path) if ROS.fullmatch(name)}


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_imports_cross_packages_in_one_direction(path: Path) -> None:
    package = owner(path)
    allowed = {package, "pipeprog_camera"} | ALLOWED[package]
    if package in CORES and knows_ros(path):
        allowed |= ALLOWED_IN_NODES
    assert {name for name in imports(path) if name == "pipeprog" or name.startswith("pipeprog_")} <= allowed


def modules_named(path: Path, package: str) -> set[str]:
    """Modules and folders right below `package` that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == package:
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{package}."):
            names.add((node.module or "").split(".")[1])
        elif isinstance(node, ast.Import):
            names |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith(f"{package}.")}
    return names


@pytest.mark.parametrize(
    "path", [path for path in MODULES if path.parent.name in FOLDERS.get(owner(path), ())], ids=ids
)
def test_folders_of_a_package_import_in_one_direction(path: Path) -> None:
    folder = path.parent.name
    assert modules_named(path, owner(path)) <= {folder, *FOLDERS[owner(path)][folder], *SHARED}


@pytest.mark.parametrize("package", FOLDERS)
def test_every_folder_of_a_package_has_its_rule(package: str) -> None:
    folders = {path.parent.name for path in (ROOT / "src" / package / package).glob("*/__init__.py")}
    assert folders == set(FOLDERS[package])


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_one_module_imports_pycolmap(path: Path) -> None:
    assert "pycolmap" not in imports(path) or path == ROOT / "src/pipeprog_sfm/pipeprog_sfm/sparse/colmap.py"


def manifest(package: Path) -> ElementTree.Element:
    return ElementTree.parse(package / "package.xml").getroot()


def test_all_versions_are_equal() -> None:
    versions = {package.name: manifest(package).findtext("version") for package in PACKAGES}
    for package in PYTHON_PACKAGES:
        found = re.search(r'version="([^"]+)"', (package / "setup.py").read_text())
        assert found is not None
        versions[f"{package.name}/setup.py"] = found.group(1)
    assert len(set(versions.values())) == 1, versions


@pytest.mark.parametrize("package", PYTHON_PACKAGES, ids=lambda package: package.name)
def test_manifest_names_what_the_package_imports(package: Path) -> None:
    files = [path for path in MODULES if owner(path) == package.name] + sorted(package.glob("launch/*.py"))
    imported = set().union(*map(imports, files)) - set(sys.stdlib_module_names) - {package.name}
    needed = {key for name in imported if (key := DEPENDENCIES.get(name, name)) is not None}
    declared = {element.text or "" for element in manifest(package).findall("exec_depend")}
    assert needed <= declared, f"add to package.xml: {sorted(needed - declared)}"


def test_manifest_of_the_messages_names_the_packages_they_use() -> None:
    package = ROOT / "src" / "pipeprog_msgs"
    used = {"builtin_interfaces"}
    for path in [*package.glob("msg/*.msg"), *package.glob("srv/*.srv")]:
        used |= set(re.findall(r"^(\w+)/\w+", path.read_text(), re.MULTILINE))
    declared = {element.text for element in manifest(package).findall("depend")}
    assert used <= declared


def test_every_python_file_names_its_licence() -> None:
    folders = ("src", "bags", "benchmarks", "examples", "setup", "tests")
    files = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py")) if "build" not in path.parts]
    lacking = [str(path.relative_to(ROOT)) for path in files if LICENCE not in path.read_text().splitlines()[:2]]
    assert not lacking, f"begin them with `{LICENCE}`"


def test_what_takes_long_to_import_is_imported_where_it_is_used() -> None:
    """A replay has six processes, and most of them need none of these; a report draws in any case."""
    slow = re.compile(r"^(import|from) (scipy\.stats|sklearn|matplotlib)\b", re.MULTILINE)
    importing = {path for path in MODULES if slow.search(path.read_text())}
    assert {str(path) for path in importing if path.parent.name != "report"} == set()
