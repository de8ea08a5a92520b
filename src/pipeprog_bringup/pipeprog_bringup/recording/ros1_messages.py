# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 1 as those of ROS 2: the same fields, packed without gaps, and a number in each header."""

from __future__ import annotations

import re
import struct

from pipeprog_bringup.recording import cdr

ENCODING = "ros1"
# Fields in their order. H: header; s: text; b: bytes; *: sequence of what follows; else a count and struct's letter.
_LAYOUTS = {
    cdr.IMAGE: "H 2I s 1B 1I b",
    cdr.COMPRESSED_IMAGE: "H s b",
    cdr.CAMERA_INFO: "H 2I s *1d 9d 9d 12d 6I 1B",
    cdr.ODOMETRY: "H s 7d 36d 6d 36d",
    cdr.IMU: "H 4d 9d 3d 9d 3d 9d",
    cdr.TF: "*(H s 7d)",
}
_OTHER_NAMES = {"tf/tfMessage": cdr.TF}
_FIELD = re.compile(r"\*?(?:\([^)]*\)|\w+)")


def ros2_type(name: str) -> str:
    """`package/msg/Name` of `package/Name`."""
    package, slash, short = name.partition("/")
    return _OTHER_NAMES.get(name, f"{package}/msg/{short}" if slash and "/" not in short else name)


def to_cdr(type_name: str, data: bytes) -> bytes:
    """CDR bytes of a message of ROS 1; no bytes where it is damaged, or of a type that nothing here reads."""
    layout = _LAYOUTS.get(type_name)
    if layout is None:
        return b""
    copy = _Copy(data)
    try:
        copy.fields(layout)
    except struct.error:
        return b""
    return b"\0\1\0\0" + bytes(copy.out)


class _Copy:
    """Copies fields from packed to aligned; struct.error where the data end before them."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0
        self.out = bytearray()

    def fields(self, layout: str) -> None:
        for field in _FIELD.findall(layout):
            if field[0] == "*":
                inner = field[1:].strip("()")
                for _ in range(self._count()):
                    self.fields(inner)
            elif field == "H":
                self._take(4)  # ROS 2 has no sequence numbers
                self._numbers(2, "I")
                self._text()
            elif field == "s":
                self._text()
            elif field == "b":
                self.out += self._take(self._count())
            else:
                self._numbers(int(field[:-1]), field[-1])

    def _take(self, count: int) -> bytes:
        """The next bytes."""
        content = self._data[self._at : self._at + count]
        if len(content) < count:
            raise struct.error("cut off")
        self._at += count
        return content

    def _align(self, size: int) -> None:
        self.out += bytes(-len(self.out) % size)

    def _numbers(self, count: int, kind: str) -> None:
        size = struct.calcsize(kind)
        self._align(size)
        self.out += self._take(size * count)

    def _count(self) -> int:
        """A length, which stands before what it counts in both."""
        self._numbers(1, "I")
        return int.from_bytes(self.out[-4:], "little")

    def _text(self) -> None:
        content = self._take(int.from_bytes(self._take(4), "little")) + b"\0"
        self._align(4)
        self.out += struct.pack("<I", len(content)) + content
