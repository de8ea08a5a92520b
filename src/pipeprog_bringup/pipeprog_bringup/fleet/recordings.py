# SPDX-License-Identifier: Apache-2.0
"""Which recordings a fleet has: files, folders, globs and addresses, each with a name for its results."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from pipeprog_bringup.fleet.storage import Mark, Place
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_NAME

_ENDINGS = (".mcap", ".db3", ".bag")
_FOLDER_FILE = "metadata.yaml"  # by which a rosbag2 folder is known
_GLOB = re.compile(r"[*?[]")
_NO_NAME = re.compile(r"[^\w .()+-]")  # characters that a path, an address or a page would have to escape


@dataclass(frozen=True)
class Inputs:
    """What a recording is surveyed with.

    Attributes:
        boq, board: addresses of the bill of quantities and of the target boards.
        settings: `node.param=value` texts, as for `pipeprog replay --set`.
        topics: options of `pipeprog replay` that choose among several cameras, such as `image_topic`, and their values.
        reference: name of the recording of the same fleet in whose frame this one stands, by the same board in the same
            place; empty where none is known.
    """

    boq: str = ""
    board: str = ""
    settings: tuple[str, ...] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    reference: str = ""


@dataclass(frozen=True)
class Recording:
    """One recording: the name of its results, its address, its files as they are listed, what it is surveyed with."""

    name: str
    uri: str
    files: Mapping[str, Mark]
    inputs: Inputs

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return sum(mark.size for mark in self.files.values())


def listed(address: str, inputs: Inputs, name: str = "") -> list[Recording]:
    """The recordings at an address, in the order of their names.

    A file is one recording, whatever it holds; so is a rosbag2 folder. Of any other folder these are the .mcap,
    .db3 and .bag files and rosbag2 folders below it, of a glob the files and folders that fit. `name` is that of a
    single recording. Raises InputError where there is none, or `name` is given to several, and StorageFailure.
    """
    if _GLOB.search(address):
        found = [one for match in Place(address).matches() for one in _at(match, inputs)]
    else:
        found = _at(address, inputs)
    if not found:
        raise InputError(
            f"{address}: holds no recording (an .mcap, .db3 or .bag file or a rosbag2 folder): check the path"
        )
    if name and len(found) > 1:
        raise InputError(f"{address}: the name '{name}' stands for {len(found)} recordings: leave it out")
    return [Recording(_fit(name), found[0].uri, found[0].files, inputs)] if name else found


def require_distinct(recordings: Sequence[Recording]) -> None:
    """Raises InputError where two recordings have one name or one address, or a reference is none of them."""
    names: dict[str, str] = {}
    for one in recordings:
        if one.name in names:
            raise InputError(
                f"{one.uri} and {names[one.name]} would both have their results in '{one.name}': give them a name "
                "each in a fleet.yaml, or give the folder above both"
            )
        names[one.name] = one.uri
    for one in recordings:
        if one.inputs.reference and one.inputs.reference not in names:
            raise InputError(f"{one.uri}: its reference '{one.inputs.reference}' is no recording of this fleet")


def _at(address: str, inputs: Inputs) -> list[Recording]:
    """The recordings of a file or folder."""
    place = Place(address)
    files = place.files()
    if not files:
        return []
    address = place.path() if place.is_local else address  # a worker may start in another folder
    base = place.path().rstrip("/").rpartition("/")[2]
    if _FOLDER_FILE in files:
        return [Recording(_fit(base), address, files, inputs)]
    if list(files) == [base] and place.is_file():
        return [Recording(_fit(_stem(base)), address, files, inputs)]
    top = address.rstrip("/")
    return [Recording(_fit(_stem(name)), f"{top}/{name}", own, inputs) for name, own in _below(files)]


def _below(files: Mapping[str, Mark]) -> Iterator[tuple[str, dict[str, Mark]]]:
    """Names of the rosbag2 folders and of the single files among the files of a folder, with the files of each."""
    folders = {name.rpartition("/")[0] for name in files if name.endswith(f"/{_FOLDER_FILE}")}
    names = [name for name in files if name.endswith(_ENDINGS) and name.rpartition("/")[0] not in folders]
    for name in sorted({*folders, *names}):
        if name in folders:
            yield name, {file[len(name) + 1 :]: mark for file, mark in files.items() if file.startswith(f"{name}/")}
        else:
            yield name, {name.rpartition("/")[2]: files[name]}


def _stem(name: str) -> str:
    return name.rpartition(".")[0] or name


def _fit(name: str) -> str:
    """A name as a folder's: `robot 1/monday` is `robot 1_monday`; never hidden, never longer than a file's may be."""
    return (_NO_NAME.sub("_", name).lstrip(".") or "_")[: MAX_NAME - 56]  # room for what is written beside it
