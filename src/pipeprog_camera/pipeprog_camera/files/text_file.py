# SPDX-License-Identifier: Apache-2.0
"""A file of text from outside, read whole: a regular file of bounded size in UTF-8."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe between processes",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}

# First bytes of files that are given in place of texts.
_BINARY = {
    b"\xff\xd8\xff": "a JPEG image",
    b"\x89PNG": "a PNG image",
    b"%PDF": "a PDF document",
    b"PK\x03\x04": "an archive or an office document",
    b"\x89MCAP": "a recording (mcap)",
}


def read_text(path: str | Path, most: int) -> str:
    """The text of a regular file of at most `most` bytes, without its byte order mark.

    Raises InputError, naming the file and the remedy, for what is no such file; a device or pipe is never opened.
    """
    data = read_bytes(path, most)
    for magic, kind in _BINARY.items():
        if data.startswith(magic):
            raise InputError(f"{path} is {kind}, not a text file: give the file that the option asks for")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}, line {line}: the byte 0x{data[error.start]:02x} is no text in UTF-8: save the file as UTF-8"
        ) from None


def require_regular(path: str | Path) -> None:
    """Raises InputError where there is no regular file (or a link to one)."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise InputError(f"no such file: {path}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot read the file ({error.strerror}): check the path") from None
    except ValueError:  # NUL, which no path has
        raise InputError(f"{shown(str(path))} is no path: give the file's path") from None
    if not stat.S_ISREG(mode):
        raise InputError(f"{path} is {_KINDS.get(stat.S_IFMT(mode), 'something else')}: give a regular file")


def read_bytes(path: str | Path, most: int) -> bytes:
    """The bytes of a regular file; raises InputError where it is none or has more than `most`."""
    require_regular(path)
    try:
        # Should a pipe take the file's place in this moment, opening it does not wait for a writer.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0))) as file:
            data = file.read(most + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot read the file ({error.strerror}): check its permissions") from None
    if len(data) > most:
        raise InputError(f"{path} is larger than {most / 2**20:g} MiB, which no such file is: check the path")
    return data
