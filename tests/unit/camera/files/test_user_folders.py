# SPDX-License-Identifier: Apache-2.0
"""Folders for the files of libraries, where there is no home."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_camera.files import user_folders
from pipeprog_camera.files.user_folders import provide_user_folders

VARIABLES = {"XDG_CACHE_HOME": ".cache", "XDG_CONFIG_HOME": ".config", "ROS_HOME": ".ros"}


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for temporary files; none of the variables is set, and none set here outlives the test."""
    for name in VARIABLES:
        monkeypatch.setenv(name, "")
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def no_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A home below a file: it cannot be made, not by root either."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "file" / "home"))


def test_a_home_that_can_be_written_is_used(tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "made when it is needed"))
    provide_user_folders()
    assert not any(os.environ[name] for name in VARIABLES)
    assert not list(temporary.iterdir())


@pytest.mark.usefixtures("no_home")
def test_without_a_home_a_private_folder_is_used_again_and_again(temporary: Path) -> None:
    for _ in range(2):
        provide_user_folders()
        (private,) = temporary.iterdir()
        assert private.stat().st_mode & 0o777 == 0o700
        assert {name: os.environ[name] for name in VARIABLES} == {
            name: str(private / default) for name, default in VARIABLES.items()
        }
        for name in VARIABLES:
            os.environ[name] = ""


@pytest.mark.usefixtures("no_home")
def test_what_the_user_has_set_and_can_be_written_is_kept(tmp_path: Path) -> None:
    os.environ["XDG_CACHE_HOME"] = str(tmp_path)
    provide_user_folders()
    assert os.environ["XDG_CACHE_HOME"] == str(tmp_path)
    assert os.environ["ROS_HOME"]


@pytest.mark.usefixtures("no_home")
def test_folders_that_others_may_write_or_lead_elsewhere_are_not_trusted(tmp_path: Path, temporary: Path) -> None:
    (temporary / "pipeprog-home-0open").mkdir()
    (temporary / "pipeprog-home-0open").chmod(0o777)
    (tmp_path / "elsewhere").mkdir(0o700)
    (temporary / "pipeprog-home-0link").symlink_to(tmp_path / "elsewhere")
    provide_user_folders()
    private = Path(os.environ["XDG_CACHE_HOME"]).parent
    assert private.name not in ("pipeprog-home-0open", "pipeprog-home-0link")
    assert private.parent == temporary


def test_a_user_without_a_name_gets_no_folder_called_tilde(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # what it does where the user's number has no name
    provide_user_folders()
    assert os.environ["XDG_CACHE_HOME"].startswith(str(temporary))


@pytest.mark.usefixtures("no_home")
def test_a_full_temporary_folder_is_not_used(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(user_folders, "_ROOM", 1 << 60)
    with pytest.raises(InputError, match="TMPDIR"):
        provide_user_folders()
    assert not list(temporary.iterdir())


@pytest.mark.usefixtures("no_home")
def test_without_any_folder_an_installation_that_can_be_written_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "file"))
    provide_user_folders()
    assert not any(os.environ[name] for name in VARIABLES)
