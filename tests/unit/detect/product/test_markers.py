# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.product.markers import UNKNOWN_COLOR, pipe_markers
from pipeprog_detect.types import Cylinder, Pipe

BOQ = BillOfQuantities((PipeClass("DN65", 0.0365, 3.0, (0.0, 0.0, 1.0), 0.0003),))


def pipe(end: np.ndarray, name: str | None) -> Pipe:
    return Pipe("p01", Cylinder(np.zeros(3), end, 0.0365), 1e-4, name, 0.99, 3.0, 1e-3, 100)


@given(st.tuples(*[st.floats(-2, 2)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_local_z_runs_along_the_pipe(end: tuple[float, float, float]) -> None:
    (marker,) = pipe_markers([pipe(np.array(end), "DN65")], BOQ)
    x, y, z, w = marker.orientation
    turned_z = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(turned_z, np.array(end) / np.linalg.norm(end), atol=1e-6)
    np.testing.assert_allclose(marker.length, np.linalg.norm(end))


def test_straight_down_and_colours() -> None:
    planned, unknown = pipe_markers([pipe(np.array([0, 0, -1.0]), "DN65"), pipe(np.array([0, 0, 1.0]), None)], BOQ)
    assert planned.color == (0.0, 0.0, 1.0)
    assert unknown.color == UNKNOWN_COLOR
    assert "unknown" in unknown.text
    assert "r 36.5 mm" in planned.text
    np.testing.assert_allclose(np.linalg.norm(planned.orientation), 1.0)
