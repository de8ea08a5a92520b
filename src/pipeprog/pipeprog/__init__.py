# SPDX-License-Identifier: Apache-2.0
"""pipeprog from Python: notebooks and scripts, without ROS.

    import pipeprog

    pipes = pipeprog.detect(points, {"DN65": 0.0365, "DN100": 0.0575})  # points (N, 3) in metres
    results = pipeprog.read_results("out/demo")  # results.pipes is a list of rows, results.points an array

What is exported here is stable; the modules behind it are described in docs/architecture.md. A name is imported when
it is first used, so that `import pipeprog` itself takes milliseconds. Lengths are metres, angles radians, stamps
nanoseconds; a transform `a_from_b` takes points in b to points in a. What a user can mend raises `InputError`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeprog.detection import detect
    from pipeprog_bringup.results.cloud_io import CloudFile, read_cloud
    from pipeprog_bringup.results.results_reader import Results, read_results
    from pipeprog_camera.camera import Camera
    from pipeprog_camera.errors import InputError
    from pipeprog_detect.config import DetectConfig
    from pipeprog_detect.product.boq import BillOfQuantities, PipeClass, load_boq
    from pipeprog_detect.types import Cloud, Cylinder, Pipe, View
    from pipeprog_frames.config import FramesConfig
    from pipeprog_frames.policy.selector import FrameSelector
    from pipeprog_sfm.boards.board_file import load_board_file
    from pipeprog_sfm.config import SfmConfig
    from pipeprog_sfm.reconstruction import Reconstruction

__all__ = [
    "BillOfQuantities",
    "Camera",
    "Cloud",
    "CloudFile",
    "Cylinder",
    "DetectConfig",
    "FrameSelector",
    "FramesConfig",
    "InputError",
    "Pipe",
    "PipeClass",
    "Reconstruction",
    "Results",
    "SfmConfig",
    "View",
    "detect",
    "load_board_file",
    "load_boq",
    "read_cloud",
    "read_results",
]

_MODULES = {
    "pipeprog.detection": ("detect",),
    "pipeprog_bringup.results.cloud_io": ("CloudFile", "read_cloud"),
    "pipeprog_bringup.results.results_reader": ("Results", "read_results"),
    "pipeprog_camera.camera": ("Camera",),
    "pipeprog_camera.errors": ("InputError",),
    "pipeprog_detect.config": ("DetectConfig",),
    "pipeprog_detect.product.boq": ("BillOfQuantities", "PipeClass", "load_boq"),
    "pipeprog_detect.types": ("Cloud", "Cylinder", "Pipe", "View"),
    "pipeprog_frames.config": ("FramesConfig",),
    "pipeprog_frames.policy.selector": ("FrameSelector",),
    "pipeprog_sfm.boards.board_file": ("load_board_file",),
    "pipeprog_sfm.config": ("SfmConfig",),
    "pipeprog_sfm.reconstruction": ("Reconstruction",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Imports an exported name when it is first used (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'pipeprog' has no attribute '{name}'")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
