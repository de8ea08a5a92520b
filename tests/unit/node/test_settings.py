# SPDX-License-Identifier: Apache-2.0
"""Settings dataclasses as flat names: built, checked, parsed and flattened again."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_camera.errors import InputError
from pipeprog_camera.setting_field import setting
from pipeprog_node.settings import build, describe, flatten, parse


@dataclass(frozen=True)
class Stereo:
    max_pairs: int = setting(2, "neighbours", limits=(1, 8))
    method: str = setting("sgm", "matcher", choices=("sgm", "bm"))


@dataclass(frozen=True)
class Config:
    overlap_min: float = setting(0.85, "least overlap", limits=(0.3, 0.99))
    lockstep: bool = setting(False, "wait")
    baseline: float | None = setting(None, "known distance", "m", (0, 9))
    stereo: Stereo = field(default_factory=Stereo)


SETTINGS = {setting.name: setting for setting in describe(Config)}


def test_names_are_flat_and_in_order() -> None:
    assert list(SETTINGS) == ["overlap_min", "lockstep", "baseline", "stereo.max_pairs", "stereo.method"]
    assert SETTINGS["baseline"].optional
    assert SETTINGS["baseline"].type is float
    assert SETTINGS["stereo.max_pairs"].range == (1, 8)


def test_without_values_the_defaults_hold() -> None:
    assert build(Config, {}) == Config()


def test_nested_values_reach_their_dataclass() -> None:
    config = build(Config, {"stereo.max_pairs": 4, "overlap_min": 0.9})
    assert config == Config(overlap_min=0.9, stereo=Stereo(max_pairs=4))


@given(
    st.builds(
        Config,
        st.floats(0.3, 0.99),
        st.booleans(),
        st.none() | st.floats(0, 9),
        st.builds(Stereo, st.integers(1, 8), st.sampled_from(["sgm", "bm"])),
    )
)
def test_flatten_is_the_inverse_of_build(config: Config) -> None:
    assert build(Config, flatten(config)) == config
    texts = {name: parse(str(value), SETTINGS[name]) for name, value in flatten(config).items()}
    assert build(Config, texts) == config


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("overlap_mni", "overlap_min"),
        ("max_pairs", "stereo.max_pairs"),
        ("stero.methd", "stereo.method"),
        ("fusion.max_pair", "stereo.max_pairs"),
    ],
)
def test_unknown_name_gives_the_nearest(name: str, near: str) -> None:
    with pytest.raises(InputError, match=f"'{name}'.*'{near}'"):
        build(Config, {name: 1})


def test_unknown_name_like_no_other_lists_all() -> None:
    with pytest.raises(InputError, match=r"there are: overlap_min, .*stereo\.method"):
        build(Config, {"zzz": 1})


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("overlap_min", "0.9", "takes a number"),
        ("overlap_min", True, "takes a number"),
        ("overlap_min", float("nan"), "takes a number"),
        ("overlap_min", 0.2, "out of range: 0.3 to 0.99"),
        ("overlap_min", None, "takes a number"),
        ("stereo.max_pairs", 9, "out of range: 1 to 8"),
        ("stereo.max_pairs", 2.0, "takes a whole number"),
        ("stereo.method", "ncc", "none of its choices: sgm, bm"),
        ("lockstep", 1, "takes true or false"),
        ("baseline", 10.0, "out of range: 0 to 9 m"),
    ],
)
def test_values_out_of_range_are_reported(name: str, value: object, text: str) -> None:
    with pytest.raises(InputError, match=text) as error:
        build(Config, {name: value})
    assert name in str(error.value)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("0.5", "overlap_min", 0.5),
        (" 3 ", "stereo.max_pairs", 3),
        ("TRUE", "lockstep", True),
        ("off", "lockstep", False),
        ("none", "baseline", None),
        ("2", "baseline", 2.0),
        ("bm", "stereo.method", "bm"),
    ],
)
def test_text_is_parsed_by_type(text: str, name: str, value: object) -> None:
    parsed = parse(text, SETTINGS[name])
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("text", "name"),
    [("many", "stereo.max_pairs"), ("2.5", "stereo.max_pairs"), ("maybe", "lockstep"), ("", "overlap_min")],
)
def test_text_of_another_type_is_reported(text: str, name: str) -> None:
    with pytest.raises(InputError, match=f"{name} = '{text}'"):
        parse(text, SETTINGS[name])
