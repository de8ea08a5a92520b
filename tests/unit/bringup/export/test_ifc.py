# SPDX-License-Identifier: Apache-2.0
"""IFC as its validator and a geometry kernel have it: no findings, right sizes, the same bytes twice."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.export.formats import export
from pipeprog_bringup.export.ifc import write_ifc
from pipeprog_bringup.export.survey import Site, Survey
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_camera.errors import InputError
from tests.unit.bringup.export.conftest import PIPES

needs_ifc = pytest.mark.skipif(
    find_spec("ifcopenshell") is None, reason="IfcOpenShell is not installed: make setup EXCHANGE=1"
)


@needs_ifc
def test_the_validator_finds_nothing_and_the_kernel_the_measured_sizes(folder: Path, tmp_path: Path) -> None:
    import ifcopenshell
    import ifcopenshell.geom
    import ifcopenshell.util.element
    import ifcopenshell.validate

    (path,) = export(folder, ["ifc"], tmp_path / "out")
    file = ifcopenshell.open(str(path))
    log = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(file, log)
    assert log.statements == []
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    segments = {segment.Name: segment for segment in file.by_type("IfcPipeSegment")}
    assert set(segments) == {"p01", "p02", "p03"}
    for pipe in PIPES:
        shape = ifcopenshell.geom.create_shape(settings, segments[pipe.id])
        vertices = np.asarray(shape.geometry.verts).reshape(-1, 3)
        along = pipe.cylinder.along(vertices)
        assert (along.min(), along.max()) == pytest.approx((0.0, pipe.cylinder.length), abs=1e-4)
        rims = np.linalg.norm(pipe.cylinder.from_axis(vertices), axis=1)
        assert rims == pytest.approx(np.full(len(rims), pipe.cylinder.radius), abs=1e-4)
        assert len(segments[pipe.id].IsNestedBy[0].RelatedObjects) == 2
        sets = ifcopenshell.util.element.get_psets(segments[pipe.id])
        assert sets["Qto_PipeSegmentBaseQuantities"]["Length"] == pytest.approx(pipe.cylinder.length, abs=1e-6)
        assert sets["Pipeprog_Measurement"]["OuterRadius"] == pytest.approx(pipe.cylinder.radius)
    kinds = {name: ifcopenshell.util.element.get_type(segment) for name, segment in segments.items()}
    assert [kinds[name] and kinds[name].Name for name in ("p01", "p02", "p03")] == [
        *("=DN65", None, "heating DN40 + sprinkler DN40"),
    ]
    assert len(file.by_type("IfcDistributionSystem")) == 3


@needs_ifc
def test_the_same_results_give_the_same_bytes_and_guids(folder: Path, tmp_path: Path) -> None:
    (once,) = export(folder, ["ifc"], tmp_path / "once")
    (again,) = export(folder, ["ifc"], tmp_path / "again")
    assert once.read_bytes() == again.read_bytes()


@needs_ifc
def test_coordinates_far_away_are_an_offset_and_a_map_conversion(folder: Path, tmp_path: Path) -> None:
    import ifcopenshell
    import ifcopenshell.validate
    from ifcopenshell.util.placement import get_local_placement

    site_from_map = np.eye(4)
    site_from_map[:3, 3] = [691_234.5, 5_334_567.25, 512.125]
    write_ifc(Survey(read_results(folder), Site(site_from_map, "EPSG:25832")), tmp_path / "far.ifc")
    file = ifcopenshell.open(str(tmp_path / "far.ifc"))
    log = ifcopenshell.validate.json_logger()
    # The schema's own rules, too; their compilation takes 4 s.
    ifcopenshell.validate.validate(file, log, express_rules=True)
    assert log.statements == []
    (conversion,) = file.by_type("IfcMapConversion")
    offset = np.array([conversion.Eastings, conversion.Northings, conversion.OrthogonalHeight])
    assert conversion.TargetCRS.Name == "EPSG:25832"
    for pipe, segment in zip(PIPES, file.by_type("IfcPipeSegment"), strict=True):
        place = get_local_placement(segment.ObjectPlacement)[:3, 3]
        assert np.abs(place).max() < 100.0
        assert place + offset == pytest.approx(pipe.cylinder.start + site_from_map[:3, 3], abs=1e-5)


def test_without_ifcopenshell_it_says_how_to_get_it(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    with pytest.raises(InputError, match="pip install ifcopenshell=="):
        export(folder, ["ifc"], tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())
