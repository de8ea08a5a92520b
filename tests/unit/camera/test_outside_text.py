# SPDX-License-Identifier: Apache-2.0
"""Texts from outside where they go out."""

from __future__ import annotations

from typing import Any

import pytest

from pipeprog_camera.outside_text import shown


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
