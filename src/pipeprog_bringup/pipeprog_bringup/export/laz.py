# SPDX-License-Identifier: Apache-2.0
"""LAZ: the cloud, compressed, in site coordinates."""

from __future__ import annotations

from pathlib import Path

from pipeprog_bringup.export.survey import Survey
from pipeprog_bringup.results.cloud_io import write_las
from pipeprog_camera.errors import InputError


def write_laz(survey: Survey, path: Path) -> None:
    """Writes the cloud as LAZ 1.4, as `cloud.las` is; raises InputError where the results have no cloud."""
    cloud = survey.results.cloud
    if cloud is None:
        raise InputError(f"{survey.results.folder} has no cloud.ply, nor the cloud that run.json names")
    normals = cloud.cloud.normals
    turned = None if normals is None else normals @ survey.site.site_from_map[:3, :3].T
    write_las(path, survey.site.place(cloud.cloud.points), cloud.colors, turned, survey.site.origin)
