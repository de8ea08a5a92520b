# SPDX-License-Identifier: Apache-2.0
"""Texts from outside where they go out."""

from __future__ import annotations

from typing import Any

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_NAME
from pipeprog_camera.outside_text import for_plot, for_spreadsheet, for_terminal, name_of, nearest, shown


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("DN50", "'DN50'"),
        ("a\nb\x1b[31m\u202e", r"'a\nb\x1b[31m\u202e'"),
        (None, "None"),
        (True, "True"),
        (2.5, "2.5"),
        (10**400, "an integer of about 400 digits"),
        ([], "[]"),
        ({}, "{}"),
        ([1, [2, [3, 4]]], "[1, [2, […]]]"),
        (list(range(100)), "[0, 1, 2, 3, …]"),
        ({"name": "a", "sizes": [1, 2]}, "{'name': 'a', 'sizes': [1, 2]}"),
        (object(), "a object"),
    ],
)
def test_a_value_is_shown(value: Any, text: str) -> None:
    assert shown(value) == text


def test_what_is_shown_is_short() -> None:
    nested: Any = ["x" * 10_000]
    for _ in range(100):  # 9^100 texts once printed in full
        nested = [nested] * 9
    for value in (nested, "x" * 10_000, {"x" * 1000: "y" * 1000}, -(1 << 100_000)):
        assert len(shown(value)) <= 80


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("DN50 ø 60 mm", "DN50 ø 60 mm"),
        ("two\nlines", "two\nlines"),
        ("\x1b[31mred\x1b[0m", r"\x1b[31mred\x1b[0m"),
        ("back\rfront\b\x07", r"back\rfront\x08\x07"),
        ("\u202eright to left", r"\u202eright to left"),
        ("\x9b2J", r"\x9b2J"),
        ("\ud800", r"\ud800"),
    ],
)
def test_texts_for_terminals_and_logs(text: str, safe: str) -> None:
    assert for_terminal(text) == safe
    for_terminal(text).encode()


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r"])
def test_cells_of_spreadsheets_are_no_formulas(start: str) -> None:
    assert for_spreadsheet(f"{start}cmd|' /C calc'!A0") == f"'{start}cmd|' /C calc'!A0"
    assert for_spreadsheet(f"DN50{start}") == f"DN50{start}"


@pytest.mark.parametrize(
    "text", ["DN50", r"$\frac{1}{$", r"a\$b$ $c", "_hidden", "$$", "\x00", "\ud800", "{}", "\\", "^_^"]
)
def test_texts_in_plots_are_drawn_as_they_are(text: str) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots()
    axes.plot([0, 1], [0, 1], label=for_plot(text))
    axes.annotate(for_plot(text), (0, 0))
    axes.set_xticks([0.5], [for_plot(text)])
    legend = axes.legend()
    figure.canvas.draw()
    (drawn,) = legend.get_texts()
    assert drawn._preprocess_math(drawn.get_text())[0].strip() == shown(text)[1:-1].replace("\\\\", "\\")
    plt.close(figure)


@pytest.mark.parametrize(
    "value", [None, True, [], {}, "", "  ", "a\nb", "\x1b[2J", "x" * (MAX_NAME + 1), "\u2066", object()]
)
def test_what_is_no_name_is_refused(value: Any) -> None:
    with pytest.raises(InputError, match=r"^bill.yaml: the name .*: write|write 256 at most"):
        name_of(value, "bill.yaml: the name")


def test_names_are_stripped_texts() -> None:
    assert [name_of(value, "x") for value in (" DN 50 ", 17, 2.5, "x" * MAX_NAME, "管")] == [
        "DN 50",
        "17",
        "2.5",
        "x" * MAX_NAME,
        "管",
    ]


def test_the_nearest_name_of_a_long_text_is_found_at_once() -> None:
    assert nearest("colour" + "r" * 1_000_000, ["color", "size"]) == "color"
