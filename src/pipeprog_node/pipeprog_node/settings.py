# SPDX-License-Identifier: Apache-2.0
"""Settings dataclasses as flat lists of named values: what ROS parameters, the command line and the docs share.

A nested dataclass is flattened with dots: field `max_pairs` of the field `stereo` is the setting `stereo.max_pairs`.
"""

from __future__ import annotations

import difflib
import math
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Any, TypeVar

from pipeprog_camera.errors import InputError

Config = TypeVar("Config")

_KINDS: dict[type, str] = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
_TRUTH = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
_UNSET = ("none", "null", "~", "")


@dataclass(frozen=True)
class Setting:
    """One leaf of a settings dataclass.

    `type` is bool, int, float or str; `range` is inclusive; an `optional` setting may be None.
    """

    name: str
    type: type
    default: Any
    description: str
    unit: str
    range: tuple[float, float] | None
    choices: tuple[Any, ...] | None
    optional: bool


def describe(config_type: type) -> list[Setting]:
    """All settings of a dataclass in the order of its fields, nested dataclasses flattened."""
    settings: list[Setting] = []
    hints = typing.get_type_hints(config_type)
    for field in fields(config_type):
        kind = hints[field.name]
        if is_dataclass(kind):
            settings += [_nested(field.name, setting) for setting in describe(typing.cast(type, kind))]
            continue
        leaf, optional = _leaf_type(kind)
        if leaf not in _KINDS or field.default is MISSING:
            raise TypeError(
                f"{config_type.__name__}.{field.name}: a setting is a bool, int, float or str with a default"
            )
        settings.append(
            Setting(
                field.name,
                leaf,
                field.default,
                field.metadata["description"],
                field.metadata["unit"],
                field.metadata.get("range"),
                field.metadata.get("choices"),
                optional,
            )
        )
    return settings


def build(config_type: type[Config], values: Mapping[str, object]) -> Config:
    """The dataclass with its defaults overridden by `values`, keyed by flat names.

    Raises InputError for an unknown name (and gives the nearest known one), a wrong type, a value out of range or
    none of the choices.
    """
    known = {setting.name: setting for setting in describe(config_type)}
    for name in values:
        if name not in known:
            raise unknown(name, known)
    return _construct(config_type, {name: check(known[name], value) for name, value in values.items()}, "")


def flatten(config: object) -> dict[str, Any]:
    """Flat names and values of a settings dataclass: the inverse of `build`."""
    flat: dict[str, Any] = {}
    for setting in describe(type(config)):
        value: Any = config
        for part in setting.name.split("."):
            value = getattr(value, part)
        flat[setting.name] = value
    return flat


def parse(text: str, setting: Setting) -> Any:
    """A value from the text of a command line or file; raises InputError as `build` does."""
    stripped = text.strip()
    if setting.optional and stripped.lower() in _UNSET:
        return None
    try:
        value: object
        if setting.type is bool:
            value = _TRUTH[stripped.lower()]
        elif setting.type is str:
            value = text
        else:
            value = setting.type(stripped)
    except (KeyError, ValueError):
        raise _wrong_type(setting, text) from None
    return check(setting, value)


def check(setting: Setting, value: object) -> Any:
    """The value in the setting's type; whole numbers pass as numbers. Raises InputError where it does not fit."""
    if value is None and setting.optional:
        return None
    if setting.type is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not setting.type:
        raise _wrong_type(setting, value)
    if isinstance(value, float) and not math.isfinite(value):
        raise _wrong_type(setting, value)
    if setting.choices is not None and value not in setting.choices:
        choices = ", ".join(str(choice) for choice in setting.choices)
        raise InputError(f"{setting.name} = {value} is none of its choices: {choices}")
    if setting.range is not None and isinstance(value, int | float):
        low, high = setting.range
        if not low <= value <= high:
            unit = f" {setting.unit}" if setting.unit else ""
            raise InputError(f"{setting.name} = {value} is out of range: {low} to {high}{unit}")
    return value


def unknown(name: str, known: Iterable[str]) -> InputError:
    """The error for a name that is no setting; its text gives the nearest known one."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if not near:  # the stage forgotten or another one named: compare what comes after the last dot
        last = {candidate.rpartition(".")[2]: candidate for candidate in names}
        near = [last[match] for match in difflib.get_close_matches(name.rpartition(".")[2], last, n=1)]
    remedy = f"did you mean '{near[0]}'?" if near else f"there are: {', '.join(names)}"
    return InputError(f"unknown setting '{name}': {remedy}")


def _nested(prefix: str, setting: Setting) -> Setting:
    return Setting(**{**vars(setting), "name": f"{prefix}.{setting.name}"})


def _leaf_type(kind: Any) -> tuple[Any, bool]:
    """The type inside `X | None`, and whether None is allowed."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        inner = [argument for argument in typing.get_args(kind) if argument is not type(None)]
        if len(inner) == 1:
            return inner[0], True
    return kind, False


def _construct(config_type: type[Config], values: Mapping[str, object], prefix: str) -> Config:
    arguments: dict[str, object] = {}
    hints = typing.get_type_hints(config_type)
    for field in fields(config_type):  # type: ignore[arg-type]  # a dataclass, which TypeVar cannot say
        name = prefix + field.name
        if is_dataclass(hints[field.name]):
            arguments[field.name] = _construct(hints[field.name], values, name + ".")
        elif name in values:
            arguments[field.name] = values[name]
    return config_type(**arguments)


def _wrong_type(setting: Setting, value: object) -> InputError:
    shown = f"'{value}'" if isinstance(value, str) else str(value)
    return InputError(f"{setting.name} = {shown}: it takes {_KINDS[setting.type]}")
