# SPDX-License-Identifier: Apache-2.0
"""The settings that a replay takes from its recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeprog_bringup import replay
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import readout_key
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_camera.errors import InputError
from tests.unit.bringup.recordings import START, image, info

BOQ = Path(__file__).parents[3] / "bags" / "demo.boq.yaml"


def recording(path: Path, readout: str) -> Path:
    with path.open("wb") as stream, BagWriter(stream) as bag:
        bag.describe({readout_key("/image"): readout})
        bag.write("/camera_info", cdr.CAMERA_INFO, info(0), START)
        bag.write("/image", cdr.COMPRESSED_IMAGE, image(0), START)
    return path


def test_the_read_out_that_a_recording_tells_is_taken_where_the_user_gives_none(tmp_path: Path) -> None:
    bag = recording(tmp_path / "phone.mcap", "0.015")
    for overrides, expected in (((), 0.015), (("sfm.readout=0.02",), 0.02), (("sfm.readout=-1",), -1.0)):
        request = replay.Request(bag, BOQ, tmp_path / "out", overrides=overrides)
        assert replay._read(request).configs["sfm"].readout == expected


@pytest.mark.parametrize("readout", ["2", "nan", "fast", "-1"])
def test_a_read_out_that_is_none_is_an_error(tmp_path: Path, readout: str) -> None:
    bag = recording(tmp_path / "phone.mcap", readout)
    with pytest.raises(InputError, match=r"phone\.mcap: .*--set sfm\.readout"):
        replay._read(replay.Request(bag, BOQ, tmp_path / "out"))
