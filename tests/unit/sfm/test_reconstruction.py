# SPDX-License-Identifier: Apache-2.0
"""When the reconstruction starts what takes long."""

from __future__ import annotations

import pytest

from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.model.row_motion import LONG_TRAJECTORY
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.reconstruction import Reconstruction


@pytest.mark.parametrize(
    ("readout", "adjusted", "expected"),
    [(0.0, 2, True), (0.015, LONG_TRAJECTORY - 1, False), (0.015, LONG_TRAJECTORY, True)],
)
def test_with_a_rolling_shutter_depth_maps_wait_until_rows_correct_the_velocities(
    readout: float, adjusted: int, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a global adjustment of fewer views they do not."""
    reconstruction = Reconstruction(SfmConfig(readout=readout), BoardFile())
    model = SparseModel()
    model.adjusted_at = adjusted
    reconstruction._map.models.append(model)
    updates: list[bool] = []
    monkeypatch.setattr(reconstruction._dense, "update", lambda keyframes, complete: updates.append(complete))
    reconstruction.update_dense()
    assert updates == [False] * expected
