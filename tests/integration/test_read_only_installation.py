# SPDX-License-Identifier: Apache-2.0
"""The packages where neither the installation nor the home folder can be written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

SOURCES = Path(__file__).parents[2] / "src"
# One module with compiled functions of each package; the file that was imported and where its functions are kept.
PROGRAM = """
import sys
sys.path[:0] = sys.argv[1:]
from pipeprog_detect.cloud import octree
from pipeprog_frames import corners
from pipeprog_sfm.features import matching
print(octree.__file__, octree.encode.stats.cache_path, sep="\\n")
"""


def test_compiled_functions_are_kept_in_a_private_temporary_folder(tmp_path: Path) -> None:
    packages = [tmp_path / name for name in ("pipeprog_camera", "pipeprog_frames", "pipeprog_sfm", "pipeprog_detect")]
    for package in packages:
        shutil.copytree(SOURCES / package.name, package, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        for folder in {module.parent for module in package.rglob("*.py")}:
            (folder / "__pycache__").write_text("")  # no folder can be made here, not by root either
    environment = {
        **os.environ,
        "HOME": str(tmp_path / "pipeprog_camera" / "package.xml" / "home"),
        "TMPDIR": str(tmp_path),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "ROS_HOME", "NUMBA_CACHE_DIR"):
        environment.pop(name, None)
    command = [sys.executable, "-c", PROGRAM, *map(str, packages)]
    ended = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    module, cache = map(Path, ended.stdout.split())
    assert tmp_path / "pipeprog_detect" in module.parents
    (private,) = tmp_path.glob("pipeprog-home-*")
    assert private in cache.parents
