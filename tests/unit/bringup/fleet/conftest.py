# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

S3_USER = {"AWS_ACCESS_KEY_ID": "user", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """Address of a local S3 server."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0, verbose=False)
    server.start()
    yield "http://{}:{}".format(*server.get_host_and_port())
    server.stop()


@pytest.fixture
def s3_folder(s3_server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Address of an empty folder in an object store."""
    for name, value in {**S3_USER, "AWS_ENDPOINT_URL": s3_server}.items():
        monkeypatch.setenv(name, value)
    s3fs = pytest.importorskip("s3fs")
    s3fs.S3FileSystem.clear_instance_cache()
    bucket = f"night-{tmp_path.name.lower().replace('_', '-')}"[:60].rstrip("-")
    s3fs.S3FileSystem().mkdir(bucket)
    return f"s3://{bucket}/fleet"


@pytest.fixture(params=["plain", "shared", "s3"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Address of an empty folder: a path, the address of a mounted folder, and one in an object store."""
    if request.param == "s3":
        address: str = request.getfixturevalue("s3_folder")
        return address
    return str(tmp_path / "place") if request.param == "plain" else f"file://{tmp_path}/shared"
