# SPDX-License-Identifier: Apache-2.0
"""The one reader of YAML from outside: plain values with their lines, within limits, or an InputError with the line.

The values are built from the parser's events, so that depth, aliases and numbers are checked before they cost memory or
time.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import read_text
from pipeprog_camera.limits import MAX_DEPTH, MAX_DIGITS, MAX_NODES, MAX_TEXT, MAX_YAML
from pipeprog_camera.outside_text import shown

_PREFIX = "tag:yaml.org,2002:"
_NUMBERS = (f"{_PREFIX}int", f"{_PREFIX}float")
# The tags that may be written, by the event that begins a value.
_TAGS = {
    yaml.ScalarEvent: {f"{_PREFIX}{name}" for name in ("str", "int", "float", "bool", "null")},
    yaml.SequenceStartEvent: {f"{_PREFIX}seq"},
    yaml.MappingStartEvent: {f"{_PREFIX}map"},
}
# Characters without a printed form and with effects on terminals, and halves of surrogate pairs; line breaks and tabs
# stay.
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x84\x86-\x9f\ud800-\udfff]")


class YamlMapping(dict[Any, Any]):
    """A mapping with the line of the file on which it begins, and the line of each key."""

    def __init__(self, line: int) -> None:
        super().__init__()
        self.line = line
        self.lines: dict[Hashable, int] = {}


class YamlList(list[Any]):
    """A list with the line of the file on which it begins, and the line of each item."""

    def __init__(self, line: int) -> None:
        super().__init__()
        self.line = line
        self.lines: list[int] = []


def read_yaml(path: str | Path, most: int = MAX_YAML) -> Any:
    """The content of a YAML file of at most `most` bytes: YamlMapping, YamlList, text, number, bool or None.

    Dates stay texts. Raises InputError, naming the file, the line and the remedy, for what is no such file, for tags
    beyond those of plain values, for keys that stand twice, and for what is beyond the limits.
    """
    return parse_yaml(read_text(path, most), str(path))


def parse_yaml(text: str, source: str) -> Any:
    """As read_yaml, of a text; `source` names it in errors."""
    if control := _CONTROL.search(text):
        where = f"{source}, line {_line_at(text, control.start())}"
        raise InputError(f"{where}: holds the control character {control[0]!r}: leave it out")
    if directive := re.search(r"^%TAG", text, re.MULTILINE):  # libyaml compares each with all before it
        raise InputError(f"{source}, line {_line_at(text, directive.start())}: %TAG has no use here: leave it out")
    try:
        reader = _Reader(source, text)
        try:
            return reader.document()
        finally:
            reader.close()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise InputError(f"{source}{line}: is no YAML ({problem}): {_remedy(text, mark)}") from None


def _remedy(text: str, mark: Any) -> str:
    """What to do about an error at a mark: of the usual mistakes, which one it is."""
    lines = text.splitlines()
    near = lines[max(0, mark.line - 1) : mark.line + 1] if mark else []
    if any("\t" in line for line in near):
        return "it has a tab: indent with spaces"
    if any(line.count(a) != line.count(b) for line in near for a, b in (("{", "}"), ("[", "]"))):
        return "a bracket is open: close each { with } and each [ with ]"
    if any(re.match(r"\s*\w+:", line) for line in near):
        return "each entry of a list begins with a dash, and its keys stand below each other: `- name: A`"
    return "mend that line, or write the file again"


def line_of(value: Any, key: Any = None) -> str:
    """`, line 12` of a value that was read (of a key or an index of it, where given), empty where it has none."""
    if not isinstance(value, YamlMapping | YamlList):
        return ""
    if key is None:
        return f", line {value.line}"
    if isinstance(value, YamlList):
        return f", line {value.lines[key]}"
    return f", line {value.lines.get(key, value.line)}"


def _line_at(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1


class _Reader:
    """Values of the events of one document; counts nodes as if each alias were written out."""

    def __init__(self, source: str, text: str) -> None:
        self._source = source
        self._loader = yaml.CSafeLoader(text)
        self._anchors: dict[str, tuple[Any, int]] = {}  # values, and how many nodes each is
        self._nodes = 0
        self._line = 0

    def close(self) -> None:
        """Frees the parser."""
        self._loader.dispose()

    def document(self) -> Any:
        """The value of the only document, None of an empty file."""
        content = None
        if not isinstance(self._next(), yaml.StreamEndEvent):  # the start of the stream
            event = self._next()
            if isinstance(event, yaml.DocumentStartEvent):
                content = self._value(self._next(), 0)
                self._next()  # the end of the document
                event = self._next()
            if not isinstance(event, yaml.StreamEndEvent):
                raise self._error("a second document begins here: keep one in a file")
        return content

    def _next(self) -> Any:
        event: Any = self._loader.get_event()
        self._line = event.start_mark.line + 1
        return event

    def _error(self, text: str) -> InputError:
        return InputError(f"{self._source}, line {self._line}: {text}")

    def _count(self, nodes: int) -> None:
        self._nodes += nodes
        if self._nodes > MAX_NODES:
            raise self._error(f"more than {MAX_NODES} values, aliases written out: check what the file repeats")

    def _value(self, event: Any, depth: int) -> Any:
        """The value that begins with `event`, within `depth` collections."""
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchors:
                raise self._error(f"the alias *{shown(event.anchor)[1:-1]} has no anchor above that is complete")
            value, nodes = self._anchors[event.anchor]
            self._count(nodes)
            return value
        before = self._nodes
        self._count(1)
        if event.tag not in (None, "!", *_TAGS[type(event)]):
            raise self._error(f"the tag {shown(event.tag)} has no meaning here: write the value without a tag")
        if isinstance(event, yaml.ScalarEvent):
            value = self._scalar(event)
        elif depth == MAX_DEPTH:
            raise self._error(f"more than {MAX_DEPTH} lists or mappings within each other: check the brackets")
        elif isinstance(event, yaml.MappingStartEvent):
            value = self._mapping(depth + 1)
        else:
            value = self._list(depth + 1)
        if event.anchor is not None:
            self._anchors[event.anchor] = value, self._nodes - before
        return value

    def _list(self, depth: int) -> YamlList:
        values = YamlList(self._line)
        while not isinstance(event := self._next(), yaml.SequenceEndEvent):
            values.lines.append(self._line)
            values.append(self._value(event, depth))
        return values

    def _mapping(self, depth: int) -> YamlMapping:
        values = YamlMapping(self._line)
        merged: list[Any] = []  # what `<<` names; its keys yield to the mapping's own
        while not isinstance(event := self._next(), yaml.MappingEndEvent):
            line = self._line
            is_merge = isinstance(event, yaml.ScalarEvent) and event.value == "<<" and event.implicit[0]
            key = self._value(event, depth)
            if isinstance(key, YamlMapping | YamlList):
                raise self._error("a list or mapping stands where a key belongs: write a name")
            value = self._value(self._next(), depth)
            if is_merge:
                merged.extend(value if isinstance(value, YamlList) else [value])
                continue
            if key in values:
                raise InputError(
                    f"{self._source}, line {line}: the key {shown(key)} stands on line {values.lines[key]} already: "
                    "keep one of them"
                )
            values[key], values.lines[key] = value, line
        for other in merged:
            if not isinstance(other, YamlMapping):
                raise self._error(f"<< is {shown(other)}: give it a mapping")
            for key in other:
                if key not in values:
                    values[key], values.lines[key] = other[key], other.lines[key]
        return values

    def _scalar(self, event: Any) -> Any:
        text: str = event.value
        if len(text) > MAX_TEXT:
            raise self._error(f"a text of {len(text)} characters: write {MAX_TEXT} at most")
        if found := _CONTROL.search(text):
            raise self._error(f"a text holds the control character {found[0]!r}: leave it out")
        node = yaml.ScalarNode(event.tag, text)
        tag = event.tag
        if tag in (None, "!"):
            tag = self._loader.resolve(yaml.ScalarNode, text, event.implicit)
        if tag in _NUMBERS and len(text) > MAX_DIGITS:
            raise self._error(f"a number of {len(text)} characters: write {MAX_DIGITS} at most, or quote it as a text")
        convert = _CONVERTERS.get(tag)
        if convert is None:
            return text
        try:
            return convert(self._loader, node)
        except (ValueError, KeyError, IndexError, OverflowError):  # PyYAML's, for `!!int x`, `!!bool x`, `!!int ""`
            raise self._error(
                f"{shown(text)} is no {tag.removeprefix(_PREFIX)}: mend it, or quote it as a text"
            ) from None


_CONVERTERS: dict[str, Any] = {
    f"{_PREFIX}null": lambda *_: None,
    f"{_PREFIX}bool": yaml.CSafeLoader.construct_yaml_bool,
    f"{_PREFIX}int": yaml.CSafeLoader.construct_yaml_int,
    f"{_PREFIX}float": yaml.CSafeLoader.construct_yaml_float,
}
