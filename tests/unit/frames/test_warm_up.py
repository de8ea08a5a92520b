# SPDX-License-Identifier: Apache-2.0
"""Nothing is left to be compiled when the first image comes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

# In a process of its own: the other tests have compiled everything.
SCRIPT = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.camera import Camera
from pipeprog_frames.warm_up import warm_up
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_frames.corners import sharpness
from pipeprog_frames.tracker import Tracker
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("pipeprog_frames")]
    kernels = {id(each): each for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)}
    return {each.__name__: len(each.signatures) for each in kernels.values()}

warm_up()
before = compiled()
for lens in ((), ("plumb_bob", (0.1, 0.0, 0.0, 0.0, 0.0)), ("equidistant", (0.1, 0.0, 0.0, 0.0))):
    tracker = Tracker(Camera(1280, 720, 900.0, 900.0, 640.0, 360.0, *lens))
    for number, frame in zip(range(3), Bag.open(Path(sys.argv[1]))):
        gray = decode_reduced(bytes(deserialize_message(frame.data, CompressedImage).data), 1280)
        sharpness(gray)
        assert (tracker.track(gray).overlap if number else tracker.start(gray)) > 0.5
assert compiled() == before, (before, compiled())
assert before["_best_of_cells"] and before["_unexplained"], before
"""


def test_the_first_image_compiles_nothing() -> None:
    demo = Path(__file__).parents[3] / "bags" / "demo.mcap"
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(demo)], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
