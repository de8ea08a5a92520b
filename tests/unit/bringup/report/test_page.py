# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeprog_bringup.report import render
from pipeprog_bringup.report.page import report
from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.cloud_io import write_ply
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe

DAY = 86_400 * 10**9
START = 1_700_000_000 * 10**9


def cylinder(x: float, length: float = 2.0, radius: float = 0.1) -> Cylinder:
    return Cylinder(np.array([x, 0.0, 0.0]), np.array([x, 0.0, length]), radius)


def survey(folder: Path, day: int = 0, length: float = 2.0, name: str = "DN<200>") -> Path:
    """Results of a run: a wall behind one pipe of a class and one of none."""
    folder.mkdir(parents=True)
    pipes = [
        Pipe("p01", cylinder(0.0, length), 0.0002, name, 0.99, 2.5, 0.001, 900),
        Pipe("p02", cylinder(0.8), 0.0002, None, 0.0, 2.5, 0.001, 900),
    ]
    classes = [ClassProgress(name, 0.1, 4.0, length, 25 * length)]
    result_files.write_pipes(folder / "pipes.json", Product(pipes, classes, []), result_files.Scale("board", 0.0004))
    wall = np.random.default_rng(0).uniform([-1, 0.15, -0.5], [2, 0.16, 2.5], (20_000, 3))
    write_ply(folder / "cloud.ply", wall, np.full((20_000, 3), 120, np.uint8))
    stamps = [START + day * DAY + i * 10**8 for i in range(5)]
    positions = np.c_[np.linspace(-1, 1, 5), np.full(5, -2.0), np.full(5, 1.5)]
    result_files.write_trajectory(folder / "trajectory.tum", stamps, positions, np.tile([0.0, 0, 0, 1], (5, 1)))
    config = {"boq": [{"name": name, "color": "#ff0000"}]}
    result_files.write_config(folder / "config.yaml", config)
    (folder / "run.json").write_text(json.dumps({"frames_considered": 40, "keyframes": 5, "losses": ["bag <torn>"]}))
    return folder


class Balanced(HTMLParser):
    """Collects the page's text, and fails where a tag is not closed."""

    VOID = ("meta", "img", "br", "link", "path", "use", "rect", "input")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeprog_bringup.report.content.STILL_WIDTH", 200)


def silent(share: float, stage: str) -> None:
    pass


def read(path: Path) -> tuple[str, str]:
    page = re.sub(r"<script>.*?</script>", "", path.read_text(), flags=re.DOTALL)  # three.js and the 3-D view
    parser = Balanced()
    parser.feed(re.sub(r"<(path|use|rect)\b([^>]*[^/])?></\1>|<(path|use|rect)\b[^>]*/>", "", page))
    assert parser.open == []
    return page, " ".join(parser.text)


def test_the_page_holds_all_there_is_and_needs_nothing_else(tmp_path: Path) -> None:
    page, text = read(report([survey(tmp_path / "run")], tmp_path / "report.html", False, silent))
    assert "http:" not in page
    assert "https:" not in page
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert "default-src 'none'; img-src data:;" in page
    for expected in (
        *("2.00 of 4.00 m installed: 50.0 %", "DN<200>", "no planned class", "bag <torn>", "board ± 0.040 %", "p02"),
        *("40 considered", "p02, 2.00 m, radius 100.0 mm: no class has its radius", "kept no keyframes (out.mcap"),
    ):
        assert expected in text, expected
    pictures = re.findall(r"data:image/jpeg;base64,([^\"]+)", page)
    assert len(pictures) == 2
    for encoded in pictures:
        image = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)
        blue, green, red = np.asarray(image).astype(int).transpose(2, 0, 1)
        assert ((red > 120) & (green < 80) & (blue < 80)).mean() > 0.003, "the red pipe is in the picture"
    assert page.count("<figcaption>") == 3, "plan and two elevations"


def test_several_surveys_become_a_series_in_the_order_of_their_dates(tmp_path: Path) -> None:
    later, earlier = survey(tmp_path / "b", 7, 3.0), survey(tmp_path / "a", 0, 1.0)
    _, text = read(report([later, earlier], tmp_path / "out", False, silent))
    assert (tmp_path / "out" / "report.html").is_file()
    assert "Progress over time" in text
    assert text.index("a (2023-11-14") < text.index("b (2023-11-21")
    assert "Pipe progress: b, 2023-11-21" in text
    assert "2.00 m more than on 2023-11-14: 0.29 m a day" in text
    assert "+2.00" in text


@pytest.mark.parametrize(
    "name", [r"$\frac{1}{$", "[/red]x", "=cmd|' /C calc'!A0", "_hidden", "<script>alert(1)</script>", "{{ 7 * 7 }}"]
)
def test_names_are_shown_as_they_are(tmp_path: Path, name: str) -> None:
    folders = [survey(tmp_path / "a", 0, name=name), survey(tmp_path / "b", 7, name=name)]
    page, text = read(report(folders, tmp_path / "report.html", False, silent))
    assert name in text
    assert "<script>" not in page


def test_classes_by_posterior_are_set_against_those_by_kmeans(tmp_path: Path) -> None:
    folder = survey(tmp_path / "run", name="<b>")
    content = json.loads((folder / "pipes.json").read_text())
    for pipe in content["pipes"]:
        pipe["class_kmeans"] = "<b>"
    (folder / "pipes.json").write_text(json.dumps(content))
    page, _ = read(report([folder], tmp_path / "report.html", False, silent))
    table = re.sub(r">\s+<", "><", page[page.index("Class by posterior") :])
    assert '<th scope="col"></th><th scope="col">&lt;b&gt;</th>' in table
    rows = [f'<tr><th scope="row">{name}</th><td>1</td></tr>' for name in ("&lt;b&gt;", "no planned class")]
    assert "".join(rows) in table


def test_a_run_with_pipes_json_alone(tmp_path: Path) -> None:
    folder = survey(tmp_path / "run")
    for name in ("cloud.ply", "trajectory.tum", "config.yaml", "run.json"):
        (folder / name).unlink()
    _, text = read(report([folder], tmp_path / "report.html", False, silent))
    assert "p01" in text


def with_fields(folder: Path, **fields: float) -> Path:
    """The survey, its one class with these fields in pipes.json."""
    content = json.loads((folder / "pipes.json").read_text())
    content["walls_m2"] = 40.0
    content["classes"][0] |= fields
    (folder / "pipes.json").write_text(json.dumps(content))
    return folder


def test_what_was_not_seen_stands_below_the_answer(tmp_path: Path) -> None:
    metres = {"missing_m": 0.5, "unclear_m": 0.0, "hidden_m": 0.4, "not_seen_m": 1.1}
    folder = with_fields(survey(tmp_path / "a"), **metres, walls_seen_percent=61.0)
    _, text = read(report([folder], tmp_path / "a.html", False, silent))
    told = "1.50 m were not seen (0.40 m hidden, 1.10 m out of view); 0.50 m were looked for and are not there"
    assert told in text
    assert "Thin coverage" in text
    assert "not seen [m]" in text


def test_without_places_the_walls_are_told(tmp_path: Path) -> None:
    folder = with_fields(survey(tmp_path / "a"), walls_seen_percent=88.0)
    _, text = read(report([folder], tmp_path / "a.html", False, silent))
    assert "88 % of the 40 m² of walls that were found was seen well enough" in text
    assert "Thin coverage" not in text


def test_zones_and_dates_of_the_bill_are_told(tmp_path: Path) -> None:
    folder = survey(tmp_path / "run")
    line = {
        "name": "riser <1>",
        "planned_length_m": 4.0,
        "zone": "level 2",
        "start": "2023-11-04",
        "finish": "2023-11-24",
    }
    result_files.write_config(
        folder / "config.yaml", {"boq": [{"name": "DN<200>", "color": "#ff0000", "lines": [line]}]}
    )
    _, shown = read(report([folder], tmp_path / "page.html", False, silent))
    assert "On schedule" in shown
    assert "level 2" in shown
    assert "riser <1>" in shown
    assert "2023-11-24" in shown


def test_a_survey_that_stopped_early_is_warned_of(tmp_path: Path) -> None:
    folder = survey(tmp_path / "a")
    (folder / "run.json").write_text(json.dumps({"frames_in_bag": 65, "frames_considered": 40}))
    _, text = read(report([folder], tmp_path / "a.html", False, silent))
    assert "The survey stopped early: 40 of 65 images were worked off" in text


def test_a_run_without_pipes(tmp_path: Path) -> None:
    folder = survey(tmp_path / "run")
    result_files.write_pipes(folder / "pipes.json", Product([], [], []), result_files.Scale("cloud", 0.0))
    _, text = read(report([folder], tmp_path / "report.html", False, silent))
    assert "as the cloud has it" in text


def test_what_cannot_be_reported_is_an_error(tmp_path: Path) -> None:
    folder = survey(tmp_path / "run")
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "pipes.json").write_text('{"pipes": [{}], "classes": []}')
    for folders, out, expected in (
        ([tmp_path / "absent"], "r.html", "no such folder"),
        ([tmp_path / "empty"], "r.html", "holds no pipes.json"),
        ([tmp_path / "bad"], "r.html", "no pipes.json of pipeprog"),
        ([folder, folder], "r.html", "given twice"),
        ([folder], "r.pdf", "name it .html"),
    ):
        with pytest.raises(InputError, match=expected):
            report(folders, tmp_path / out, False, silent)
    (tmp_path / "r.html").write_text("mine")
    with pytest.raises(InputError, match="--force"):
        report([folder], tmp_path / "r.html", False, silent)


def test_a_pdf_without_a_browser_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = survey(tmp_path / "run")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="apt-get install chromium"):
        report([folder], tmp_path / "r.html", False, silent, pdf=True)
    assert not (tmp_path / "r.html").exists()


def test_the_nearer_surface_is_seen() -> None:
    front = render.ColoredPipe(cylinder(0.0), (1.0, 0.0, 0.0), "")
    back = render.ColoredPipe(Cylinder(np.array([0, 1.0, 0]), np.array([0, 1.0, 2]), 0.1), (0.0, 0.0, 1.0), "")
    seen = render.draw(np.empty((0, 3)), None, [back, front], np.array([0.0, -1.0, 0.0]), 300)
    middle = seen[seen.shape[0] // 2, 150].astype(int)
    assert middle[0] > 150 > middle[2]


def test_the_two_sides_are_those_from_which_the_pipes_are_seen() -> None:
    wall = np.random.default_rng(0).uniform([-2, 0.2, -1], [2, 0.21, 3], (20_000, 3))
    pipes = [render.ColoredPipe(cylinder(x), (1, 0, 0), "") for x in (-0.5, 0.5)]
    first, second = render.two_sides(wall, pipes)
    assert first[1] < 0
    assert second[1] < 0
    assert np.degrees(np.arccos(first[:2] @ second[:2])) >= 49


def test_a_place_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    begun = []
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="choose another --out"):
        report([survey(tmp_path / "run")], tmp_path / "file" / "report.html", False, lambda *shown: begun.append(shown))
    assert not begun
