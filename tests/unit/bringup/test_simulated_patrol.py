# SPDX-License-Identifier: Apache-2.0
"""What a simulated patrol refuses before any node is started."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.simulated_patrol import Request, simulate_patrol
from pipeprog_camera.errors import InputError
from tests.unit.bringup.recordings import START, image, info

BOQ = Path(__file__).parents[3] / "bags" / "demo.boq.yaml"


def recording(path: Path, cameras: int = 1) -> Path:
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as stream, BagWriter(stream) as bag:
        for name in (f"camera{number}" for number in range(cameras)):
            bag.write(f"/{name}/camera_info", cdr.CAMERA_INFO, info(0, frame_id=name), START)
            bag.write(f"/{name}/image/compressed", cdr.COMPRESSED_IMAGE, image(0, name), START)
    return path


@pytest.mark.parametrize(
    ("names", "change", "expected"),
    [
        (["a.mcap"], {"rate": 0.0}, r"--rate 0"),
        (["a.mcap", "one/a.mcap"], {}, r"same name \(a, a\)"),
        (["b.mcap", "a.mcap"], {"out": "taken"}, r"taken/a exists: choose another --out"),
        (["a.mcap", "two.mcap"], {"rig": True}, r"two\.mcap has not the cameras of .*a\.mcap"),
        (["a.mcap"], {"overrides": ["sfm.boord=1"]}, r"sfm\.boord"),
        (["none.mcap"], {}, r"none\.mcap"),
    ],
)
def test_what_cannot_be_walked_is_refused(
    tmp_path: Path, names: list[str], change: dict[str, object], expected: str
) -> None:
    for name in ("a.mcap", "b.mcap", "one/a.mcap"):
        recording(tmp_path / name)
    recording(tmp_path / "two.mcap", cameras=2)
    (tmp_path / "taken" / "a").mkdir(parents=True)
    given = {"out": "out"} | change
    request = Request([tmp_path / name for name in names], BOQ, **given | {"out": tmp_path / str(given["out"])})  # type: ignore[arg-type]
    with pytest.raises(InputError, match=expected):
        simulate_patrol(request, lambda _: None)
    assert not (tmp_path / "out").exists()
