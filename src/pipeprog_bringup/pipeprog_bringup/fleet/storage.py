# SPDX-License-Identifier: Apache-2.0
"""Folders at any address that fsspec reads and writes: plain files, shared folders, S3 and others."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fsspec.core
from fsspec.implementations.local import LocalFileSystem

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import for_terminal, shown


class StorageFailure(Exception):
    """A storage that does not answer, or not as it should: what a second try may mend."""


@dataclass(frozen=True)
class Mark:
    """What tells two versions of a file apart without reading it: bytes, and the time or tag that its storage gives."""

    size: int
    stamp: str


class Place:
    """A file or folder at an address; names are relative to it.

    Its methods raise InputError for what is not there or may not be read, StorageFailure for all else.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        try:
            # Listings are asked for anew each time: others write there meanwhile.
            self._fs, self._root = fsspec.core.url_to_fs(uri, use_listings_cache=False)
        except (ImportError, ValueError) as error:
            raise InputError(f"{shown(uri)}: no storage can be reached by this address ({error})") from None

    @property
    def is_local(self) -> bool:
        """Whether its files have paths on this machine."""
        return isinstance(self._fs, LocalFileSystem)

    def path(self, name: str = "") -> str:
        """The path of a name, without the address' protocol."""
        return f"{self._root.rstrip('/')}/{name}" if name else self._root

    def is_file(self) -> bool:
        """Whether the address itself is a file."""
        with _told(self.uri):
            return bool(self._fs.isfile(self._root))

    def files(self, name: str = "") -> dict[str, Mark]:
        """All files below a folder by their names relative to it; none where there is no such folder.

        Of a file, the file itself under its own name.
        """
        root = self.path(name)
        with _told(self.uri):
            found: dict[str, dict[str, Any]] = self._fs.find(root, detail=True)
        return {_relative(path, root): _mark(details) for path, details in sorted(found.items())}

    def matches(self) -> list[str]:
        """The addresses that fit the address as a glob, in order."""
        with _told(self.uri):
            return [str(self._fs.unstrip_protocol(path)) for path in sorted(self._fs.glob(self._root))]

    def read(self, name: str = "") -> bytes:
        """The content of a file."""
        with _told(f"{self.uri}/{name}" if name else self.uri):
            content: bytes = self._fs.cat_file(self.path(name))
        return content

    def read_all(self, names: Sequence[str]) -> dict[str, bytes]:
        """The contents of those of the files that can be read, several at once where the storage can do so."""
        with _told(self.uri):
            found = self._fs.cat([self.path(name) for name in names], on_error="omit") if names else {}
        return {name: found[self.path(name)] for name in names if self.path(name) in found}

    def fetch(self, names: Iterable[str], target: Path) -> None:
        """Copies files to the same names below the folder `target`."""
        pairs = [(self.path(name), target / name) for name in names]
        for _, local in pairs:
            local.parent.mkdir(parents=True, exist_ok=True)
        with _told(self.uri):
            self._fs.get([path for path, _ in pairs], [str(local) for _, local in pairs])

    def store(self, folder: Path, names: Sequence[str], below: str) -> None:
        """Copies files of a local folder to the same names below `below`."""
        targets = [self.path(f"{below}/{name}") for name in names]
        self._make_folders(targets)
        with _told(self.uri):
            self._fs.put([str(folder / name) for name in names], targets)

    def write(self, name: str, content: bytes) -> None:
        """Writes one small file."""
        path = self.path(name)
        self._make_folders([path])
        with _told(self.uri):
            if not self.is_local:
                self._fs.pipe_file(path, content)  # object stores show a file when it is whole
                return
            part = Path(f"{path}.part")
            part.write_bytes(content)
            part.replace(path)

    def remove(self, names: Iterable[str]) -> None:
        """Removes files, and folders of a file system that are empty then."""
        with _told(self.uri):
            for name in names:
                with contextlib.suppress(FileNotFoundError):
                    self._fs.rm_file(self.path(name))
                if self.is_local:
                    with contextlib.suppress(OSError):
                        Path(self.path(name)).parent.rmdir()

    def _make_folders(self, paths: Iterable[str]) -> None:
        if self.is_local:  # object stores have no folders
            with _told(self.uri):
                for folder in {Path(path).parent for path in paths}:
                    folder.mkdir(parents=True, exist_ok=True)


def link_or_fetch(uri: str, target: Path) -> dict[str, Mark]:
    """The file or folder at `uri` as `target`: a link where it lies on this machine, else a copy; its files' marks.

    Raises InputError where it is not there or `target` has no room, StorageFailure where the copy is torn.
    """
    place = Place(uri)
    files = place.files()
    if not files:
        raise InputError(f"no such file or folder: {uri}")
    target.parent.mkdir(parents=True, exist_ok=True)
    if place.is_local:
        target.symlink_to(place.path())
        return files
    needed, free = sum(mark.size for mark in files.values()), shutil.disk_usage(target.parent).free
    if free < needed:
        raise InputError(
            f"{target.parent} has {free / 1e6:.0f} MB left and {uri} takes {needed / 1e6:.0f} MB: make room, or start "
            "the worker with a --local-directory that has it"
        )
    single = place.is_file()
    with _told(uri):
        if single:
            place._fs.get_file(place.path(), str(target))
        else:
            place.fetch(files, target)
    for name, mark in files.items():
        size = (target if single else target / name).stat().st_size
        if size != mark.size:
            raise StorageFailure(f"{uri}: {size} of {mark.size} bytes of {name} have come")
    return files


def _relative(path: str, root: str) -> str:
    return path.rstrip("/").rpartition("/")[2] if path == root else path[len(root.rstrip("/")) + 1 :]


def _mark(details: dict[str, Any]) -> Mark:
    stamps = (details.get(key) for key in ("ETag", "etag", "mtime", "LastModified", "last_modified", "created"))
    return Mark(int(details.get("size") or 0), str(next((stamp for stamp in stamps if stamp is not None), "")))


@contextlib.contextmanager
def _told(uri: str) -> Iterator[None]:
    """What a storage raises as our own exceptions; each of fsspec's storages has other ones."""
    try:
        yield
    except (InputError, StorageFailure):
        raise
    except FileNotFoundError:
        raise InputError(f"no such file or folder: {uri}") from None
    except PermissionError as error:
        raise InputError(
            f"{uri}: access is refused ({_words(error)}): check its permissions, or the credentials in the environment"
        ) from None
    except Exception as error:
        raise StorageFailure(f"{uri}: {_words(error)}") from error


def _words(error: Exception) -> str:
    return for_terminal(" ".join(str(error).split())[:200] or type(error).__name__)
