# SPDX-License-Identifier: Apache-2.0
import re

import numpy as np
import pytest
from targets import BOARD, LOPSIDED

from pipeprog_camera.errors import InputError
from pipeprog_sfm.boards.board_print import POINTS_PER_MM, board_pdf


def test_circles_have_their_true_size_and_places():
    text = board_pdf([LOPSIDED], "A2").decode("ascii")
    scaling = re.search(r"([\d.]+) 0 0 [\d.]+ 0 0 cm", text)
    assert scaling is not None
    factor = float(scaling[1])
    discs = re.findall(r"([\d.]+) ([\d.]+) m\n((?:[\d. ]+ c\n){4})f", text)
    places = []
    for _, _, curves in discs:
        ends = np.array([[float(value) for value in line.split()[4:6]] for line in curves.splitlines()])
        places.append(ends.mean(0))
        assert np.ptp(ends, axis=0) * factor / POINTS_PER_MM == pytest.approx([60, 60], abs=1e-3)
    expected = 1000 * LOPSIDED.centres[:, :2]
    assert np.array(places) - places[0] == pytest.approx(expected - expected[0], abs=1e-3)


def test_every_object_is_where_the_table_says():
    document = board_pdf([LOPSIDED, BOARD], "A1")
    table = re.search(rb"startxref\n(\d+)", document)
    assert table is not None
    start = int(table[1])
    offsets = re.findall(rb"(\d{10}) 00000 n", document[start:])
    assert document.count(b"/Type /Page ") == 2
    for number, offset in enumerate(offsets, 1):
        assert document[int(offset) :].startswith(b"%d 0 obj" % number)


def test_a_board_that_does_not_fit_names_a_paper_that_does():
    with pytest.raises(InputError, match=r"does not fit on A3: print it on A1"):
        board_pdf([BOARD], "A3")
    with pytest.raises(InputError, match=r"'B5' is unknown.*A3"):
        board_pdf([BOARD], "B5")
