# SPDX-License-Identifier: Apache-2.0
"""`pipeprog report`: one HTML page, with everything in it, about one survey or several."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined, Template

from pipeprog_bringup.report import plots, viewer_data
from pipeprog_bringup.report.content import Content, change_words, gather, kmeans_matrix
from pipeprog_bringup.report.paper import browser, print_page
from pipeprog_bringup.report.summary import metres, with_sigma
from pipeprog_bringup.report.survey_reader import Survey, read_surveys
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_bringup.results.results_reader import UNPLANNED, Color
from pipeprog_camera.errors import InputError


def report(
    folders: Sequence[Path], out: Path, force: bool, show: Callable[[float, str], None], pdf: bool = False
) -> Path:
    """Write the page about the runs in `folders`, the newest in full, and with `pdf` its print beside it.

    `out` is an .html file, or a folder that gets a report.html. Returns the page's file. Raises InputError where a
    folder holds no results, or where two are surveys of different sites.
    """
    target = out / "report.html" if out.is_dir() or not out.suffix else out
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--out {out}: the report is a page, name it .html")
    surveys = read_surveys(folders)
    if pdf:
        browser()
    with output_file(target, force) as temporary:
        content = gather(surveys, show)
        show(0.8, "page")
        # Halves of surrogate pairs, which JSON can hold, are no text in UTF-8.
        temporary.write_text(page(content), encoding="utf-8", errors="replace")
    if pdf:
        show(0.9, "print")
        with output_file(target.with_suffix(".pdf"), force) as temporary:
            print_page(target, temporary)
    show(1.0, "done")
    return target


def page(content: Content) -> str:
    """The page as text, without any reference to a file or a host; web/page.html is its template."""
    newest = content.newest
    previous = content.surveys[-2] if len(content.surveys) > 1 else None
    progress, radii = content.progress(), content.radii()
    return _template().render(
        title=f"Pipe progress: {newest.name}",
        content=content,
        unplanned_color=UNPLANNED,
        progress=None if progress is None else plots.svg(progress),
        series=_series(content.surveys),
        drawings=[(name, plots.svg(figure)) for name, figure in content.drawings()],
        radii=None if radii is None else plots.svg(radii),
        kmeans=kmeans_matrix(newest),
        view=viewer_data.view(newest, previous, content.letters),
        cloud=viewer_data.cloud_bytes(content.cloud),
        style=_own("page.css"),
        three=_own("three.js"),
        viewer=_own("viewer.js"),
    )


def _own(name: str) -> str:
    """A file of web/, which goes into the page as it is."""
    return (resources.files(__package__) / "web" / name).read_text(encoding="utf-8")


def _template() -> Template:
    """web/page.html; what is put into it is escaped, and a name that is missing is an error."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(css=_css, jpeg=_jpeg, metres=metres)
    environment.globals.update(with_sigma=with_sigma, change_words=change_words)
    return environment.from_string(_own("page.html"))


def _series(surveys: Sequence[Survey]) -> dict[str, Any]:
    """Table of the metres installed at each survey; None in a row where the bill had no such class yet."""
    names = list(dict.fromkeys(str(entry["class"]) for survey in surveys for entry in survey.classes))
    return {"names": names, "rows": [(survey, [survey.installed.get(name) for name in names]) for survey in surveys]}


def _css(color: Color) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in color)


def _jpeg(data: bytes) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
