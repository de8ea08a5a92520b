# SPDX-License-Identifier: Apache-2.0
"""The page as people see it: in Chromium, on a desktop, on a phone and on paper."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.report.page import report
from pipeprog_bringup.report.paper import print_page
from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.cloud_io import write_ply
from pipeprog_bringup.results.plan_file import write_plan
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Pipe
from pipeprog_sfm.alignment.map_file import MAP_FILE, write_map
from pipeprog_sfm.alignment.survey_map import MappedBoard
from tests.browser import CHROMIUM, WITHOUT, Browser
from tests.unit.bringup.report.filmed import LEVEL, UPRIGHT, looking_along_y, run
from tests.unit.bringup.results.test_lives import mapped

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=WITHOUT)

DESKTOP, PHONE = (1400, 900), (390, 844)
INCH = 96  # CSS px
PAPERS = {"A4": (8.27, 11.69), "Letter": (8.5, 11.0)}  # inch
BORDER = 12 / 25.4  # inch, of @page


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a filmed site of six classes, whose names would be markup."""
    folder = tmp_path_factory.mktemp("run")
    run(folder, [looking_along_y(x) for x in (-0.5, 0.0, 0.5)])
    names = ["<script>alert(1)</script>", *(f"DN{size}" for size in (65, 100, 150, 200, 225))]
    pipes = [Pipe(f"p0{k}", c, 1e-4, names[k], 1.0, 2.5, 1e-3, 900) for k, c in enumerate((UPRIGHT, LEVEL))]
    classes = [ClassProgress(name, 0.05, 10.0, 6.2, 62.0) for name in names]
    result_files.write_pipes(folder / "pipes.json", Product(pipes, classes, []), result_files.Scale("board", 0.0004))
    plan(folder, names[1])
    board = MappedBoard("A", np.array([[0.5, 2.1, 0.0], [0.6, 2.1, 0.0], [0.5, 2.1, 0.2], [0.6, 2.1, 0.2]]))
    write_map(folder / MAP_FILE, replace(mapped("own", ""), boards=(board,)))
    wall = np.random.default_rng(0).uniform([-1, 2.1, -1], [1, 2.11, 1], (5000, 3))
    write_ply(folder / "cloud.ply", wall, np.full((5000, 3), 120, np.uint8))
    return report([folder], tmp_path_factory.mktemp("page") / "report.html", False, lambda share, stage: None)


def plan(folder: Path, class_name: str) -> None:
    """One planned pipe that is installed and one that is missing."""
    content = json.loads((folder / "pipes.json").read_text())
    metres = dict.fromkeys(("planned_m", "installed_m", "missing_m", "unclear_m", "hidden_m", "not_seen_m"), 0.0)
    states = {"there": "installed", "still to come": "missing"}
    content["planned"] = [{"id": i, "name": i, "class": class_name, "state": s, **metres} for i, s in states.items()]
    (folder / "pipes.json").write_text(json.dumps(content))
    write_plan(folder / "plan.json", [PlannedPipe(name, name, LEVEL, class_name, 0) for name in states])


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


def box(browser: Browser, selector: str) -> list[float]:
    """Left, top, right, bottom of an element in the window [CSS px]."""
    return browser.run(
        f"(() => {{const r = document.querySelector({selector!r}).getBoundingClientRect();"
        "return [r.left, r.top, r.right, r.bottom]})()"
    )


def assert_answered(browser: Browser, width: float, height: float) -> None:
    """The answer and the whole table of classes lie within the first screen, and nothing hangs out sideways."""
    for selector in ("#answer", "#classes", "#classes tbody tr:last-child"):
        left, top, right, bottom = box(browser, selector)
        assert left >= 0, selector
        assert top >= 0, selector
        assert right <= width, selector
        assert bottom <= height, selector
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    assert browser.run("document.getElementById('answer').innerText") == "37.2 of 60.0 m installed: 62.0 %"


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_the_first_screen_answers(browser: Browser, page: Path, size: tuple[int, int]) -> None:
    browser.open(page, *size, touch=size == PHONE)
    assert_answered(browser, *size)
    assert browser.faults() == [], "no error, nothing asked of the network, no script of a class name"
    cells = browser.run("[...document.querySelectorAll('#classes tbody tr')].map((row) => row.innerText)")
    assert all("6.20" in cell and "10.00" in cell and "62.0" in cell for cell in cells)


@pytest.mark.parametrize("paper", PAPERS)
def test_the_first_sheet_of_paper_answers(browser: Browser, page: Path, paper: str, tmp_path: Path) -> None:
    width, height = (INCH * (side - 2 * BORDER) for side in PAPERS[paper])
    browser.open(page, round(width), round(height))
    browser.call("Emulation.setEmulatedMedia", media="print")
    try:
        assert_answered(browser, width, height)
        assert browser.run("getComputedStyle(document.getElementById('still')).display") == "inline-block"
        assert browser.run("[...document.querySelectorAll('canvas, .screen')].every((e) => !e.offsetParent)")
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")
    for backgrounds in (False, True):
        browser.pdf(tmp_path / "page.pdf", *PAPERS[paper], backgrounds)
        assert (tmp_path / "page.pdf").read_bytes().count(b"/Type /Page\n") in range(1, 8)


def test_the_report_as_pdf(page: Path, tmp_path: Path) -> None:
    print_page(page, tmp_path / "report.pdf")
    written = (tmp_path / "report.pdf").read_bytes()
    assert written.startswith(b"%PDF")
    assert written.count(b"/Subtype /Image") >= 4, "two photographs of the pipes and two stills"


def test_a_click_on_a_pipe_shows_its_row_and_photograph(browser: Browser, page: Path) -> None:
    browser.open(page, *DESKTOP)
    for number in (1, 0):
        browser.click(*browser.run(f"reportView.place({number})"))
        assert browser.run("reportView.chosen()") == number
        assert browser.run("document.querySelector('.pipe.chosen').dataset.pipe") == str(number)
        _, top, _, bottom = box(browser, ".pipe.chosen")
        assert bottom > 0
        assert top < DESKTOP[1]
        assert browser.run("document.querySelector('#selected img').src") == browser.run(
            f"document.querySelector('#pipe-{number + 1} .photographs img').src"
        )


def test_a_click_on_a_row_shows_its_pipe(browser: Browser, page: Path) -> None:
    browser.open(page, *DESKTOP)
    browser.run("document.getElementById('pipe-2').scrollIntoView()")
    left, top, _, _ = box(browser, "#pipe-2 h3")
    browser.click(left + 5, top + 5)
    assert browser.run("reportView.chosen()") == 1
    left, top, right, bottom = box(browser, "#view canvas")
    x, y = browser.run("reportView.place(1)")
    assert abs(x - 0.5 * (left + right)) < 2
    assert abs(y - 0.5 * (top + bottom)) < 2
    assert browser.run("document.querySelector('#view .label').textContent") == "p01 B"


def test_a_finger_chooses_a_pipe_and_a_row(browser: Browser, page: Path) -> None:
    browser.open(page, *PHONE, touch=True)
    browser.run("document.getElementById('view').scrollIntoView()")
    browser.settle()
    x, y = browser.run("reportView.place(1)")
    browser.tap(x, y + 5)  # px beside its middle
    assert browser.run("reportView.chosen()") == 1
    _, top, _, bottom = box(browser, "#selected img")
    assert top >= 0
    assert bottom <= PHONE[1]
    browser.run("document.getElementById('pipe-1').scrollIntoView()")
    left, top, _, _ = box(browser, "#pipe-1 h3")
    browser.tap(left + 5, top + 5)
    assert browser.run("reportView.chosen()") == 0


def test_keys_choose_and_turn(browser: Browser, page: Path) -> None:
    browser.open(page, *DESKTOP)
    browser.run("document.getElementById('view').focus()")
    before = browser.run("reportView.place(0)")
    browser.press("ArrowLeft")
    assert np.linalg.norm(np.subtract(browser.run("reportView.place(0)"), before)) > 1
    browser.press("n")
    browser.press("n")
    assert browser.run("reportView.chosen()") == 1
    browser.press("Enter")
    assert browser.run("document.activeElement.id") == "pipe-2"
    browser.press("Enter")
    assert browser.run("reportView.chosen()") == 1


def test_each_kind_is_one_draw_call(browser: Browser, page: Path) -> None:
    browser.open(page, *DESKTOP)
    drawn = browser.run("reportView.drawn()")
    assert drawn["calls"] == 5, "cloud, pipes, planned pipes, cameras, boards"
    assert drawn["points"] == 5000


def test_without_webgl_the_still_stays(tmp_path: Path, page: Path) -> None:
    with Browser(tmp_path, "--disable-3d-apis") as browser:
        browser.open(page, *DESKTOP)
        left, _, right, _ = box(browser, "#still")
        assert right - left > 300
        assert not browser.run("document.querySelector('canvas')")


def test_planned_pipes_that_are_not_installed_stand_in_the_view(page: Path, browser: Browser) -> None:
    browser.open(page, *DESKTOP)
    assert "planned, not installed" in browser.run("document.getElementById('layers').textContent")
    planned = browser.run("JSON.parse(document.getElementById('view-data').textContent).planned")
    assert [pipe["id"] for pipe in planned] == ["still to come"]


def test_boards_stand_in_the_view(page: Path, browser: Browser) -> None:
    browser.open(page, *DESKTOP)
    assert "boards" in browser.run("document.getElementById('layers').textContent")
    boards = browser.run("JSON.parse(document.getElementById('view-data').textContent).boards")
    assert [(board["name"], len(board["lines"])) for board in boards] == [("A", 5)], "its edge and four circles"
