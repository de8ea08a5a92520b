# SPDX-License-Identifier: Apache-2.0
"""What the command shows: progress on stderr, tables on stdout."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from pipeprog_camera.outside_text import for_terminal

if TYPE_CHECKING:
    from pipeprog_bringup.comparison.comparison import Step
    from pipeprog_bringup.fleet.task import Outcome
    from pipeprog_bringup.playback.session import State
    from pipeprog_detect.product.product import Product

_LINE_SECONDS = 10.0  # between two lines of progress in a file: few for a survey of minutes, soon enough to be seen


def output_console() -> Console:
    """The console for tables: as wide as the terminal, 120 columns where stdout is a file or a pipe."""
    return Console(width=None if sys.stdout.isatty() else 120)


def progress_display() -> Progress:
    """Bars with stage, share and time on stderr; only the last state where stderr is no terminal."""
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[detail]}", markup=False),
        TimeElapsedColumn(),
        console=Console(stderr=True),
    )


@contextlib.contextmanager
def share_bar(name: str, quiet: bool = False) -> Iterator[Callable[[float, str], None]]:
    """One bar, moved by calls with the share done (0..1) and what is being done; lines where stderr is no terminal."""
    if quiet:
        yield lambda share, stage: None
        return
    if not sys.stderr.isatty():
        lines = _Lines()
        yield lambda share, stage: lines.tell(name, f"{name}: {100 * share:.0f} %, {stage}")
        return
    with progress_display() as display:
        task = display.add_task(name, total=1.0, detail="")

        def report(share: float, stage: str) -> None:
            display.update(task, completed=share, detail=stage)

        yield report


@contextlib.contextmanager
def replay_bars(quiet: bool = False) -> Iterator[Callable[[State], None]]:
    """Three bars, moved by the states of a replay: frames considered, keyframes registered, stage.

    Lines in place of bars where stderr is no terminal.
    """
    if quiet:
        yield lambda state: None
        return
    if not sys.stderr.isatty():
        lines = _Lines()
        yield lambda state: lines.tell(
            state.stage,
            f"replay: {state.stage}, {state.considered} of {state.frames} frames considered, "
            f"{state.registered} of {state.keyframes} keyframes registered",
        )
        return
    with progress_display() as display:
        frames = display.add_task("frames considered", total=None, detail="")
        keyframes = display.add_task("keyframes registered", total=None, detail="")
        stage = display.add_task("starting", total=None, detail="")

        def report(state: State) -> None:
            counted = f"{state.considered}/{state.frames}"
            display.update(frames, total=state.frames, completed=state.considered, detail=counted)
            registered = f"{state.registered}/{state.keyframes}"
            display.update(keyframes, total=state.keyframes or None, completed=state.registered, detail=registered)
            display.update(stage, description=state.stage)

        yield report


class _Lines:
    """Progress as lines on stderr, for a file or a pipe: one for each stage, and one now and then within it."""

    def __init__(self) -> None:
        self._stage, self._told = "", 0.0

    def tell(self, stage: str, line: str) -> None:
        """Print a line if it is of a new stage, or the last is some seconds old."""
        now = time.monotonic()
        if stage != self._stage or now > self._told + _LINE_SECONDS:
            self._stage, self._told = stage, now
            print(for_terminal(line), file=sys.stderr, flush=True)


class FleetDisplay:
    """Context with a line for each recording that is being surveyed and one for all; lines that stay for what is done.

    Of each: frames and keyframes, stage, time left while frames are played; in all: recordings done, time left.
    """

    def __init__(self) -> None:
        self._progress = progress_display()
        self._lines: dict[str, TaskID] = {}
        self._started: dict[str, float] = {}
        self._seconds: list[float] = []  # of the surveys that are done

    def __enter__(self) -> FleetDisplay:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def begin(self, total: int, kept: int) -> None:
        """How many recordings there are, and of how many the results are there."""
        self._total = self._progress.add_task("recordings", total=total, completed=kept, detail=f"{kept}/{total}")

    def tell(self, state: dict[str, Any]) -> None:
        """Where one survey stands; without a stage it is over."""
        if "lost" in state:
            self._progress.console.print(_name(state["lost"]))
            return
        name = state["name"]
        if not state["stage"]:
            self._drop(name)
            return
        if name not in self._lines:
            self._lines[name] = self._progress.add_task(for_terminal(name), total=None, detail="")
            self._started[name] = time.monotonic()
        frames, considered = state.get("frames"), state.get("considered", 0)
        detail = state["stage"]
        if frames:
            detail = f"{considered}/{frames} frames, {state['registered']}/{state['keyframes']} keyframes, {detail}"
            if 0 < considered < frames:
                elapsed = time.monotonic() - self._started[name]
                detail += f", {_minutes(elapsed * (frames - considered) / considered)} left"
        self._progress.update(self._lines[name], total=frames, completed=considered, detail=detail)

    def end(self, outcome: Outcome) -> None:
        """What became of one."""
        if name_started := self._started.pop(outcome.name, None):
            self._seconds.append(time.monotonic() - name_started)
        self._drop(outcome.name)
        self._progress.advance(self._total)
        total = self._progress.tasks[self._total]
        detail = f"{total.completed:.0f}/{total.total:.0f}"
        if self._seconds and not total.finished:
            mean = sum(self._seconds) / len(self._seconds)
            detail += f", {_minutes(mean * (total.remaining or 0.0) / max(1, len(self._lines)))} left"
        self._progress.update(self._total, detail=detail)
        words = ": ".join(filter(None, (outcome.state, outcome.reason)))
        self._progress.console.print(_name(f"{outcome.name}: {words}"), soft_wrap=True)

    def _drop(self, name: str) -> None:
        if name in self._lines:
            self._progress.remove_task(self._lines.pop(name))


def print_progress(product: Product) -> None:
    """Planned and installed metres of each class; a last row for the pipes of no planned class."""
    table = Table(title="Progress", title_justify="left")
    table.add_column("class")
    for name in ("outer radius [mm]", "pipes", "installed [m]", "± sigma [m]", "planned [m]", "%"):
        table.add_column(name, justify="right")
    for entry in product.classes:
        count = sum(pipe.class_name == entry.name for pipe in product.pipes)
        sigma = product.installed_sigma(entry.name)
        sigma_text = f"{sigma:.3f}" if math.isfinite(sigma) else "-"
        lengths = (f"{entry.installed:.2f}", sigma_text, f"{entry.planned:.2f}", f"{entry.percent:.1f}")
        table.add_row(_name(entry.name), f"{1e3 * entry.outer_radius:.1f}", str(count), *lengths)
    others = [pipe for pipe in product.pipes if pipe.class_name is None]
    if others:
        total = sum(pipe.cylinder.length for pipe in others)
        table.add_row("[dim]no planned class", "", str(len(others)), f"{total:.2f}", "", "", "")
    output_console().print(table)


def print_steps(steps: Sequence[Step]) -> None:
    """What became of each pipe, one table a step from survey to survey."""
    for step in steps:
        table = Table(title=f"{_name(step.earlier)} to {_name(step.later)}", title_justify="left")
        for name in ("pipe", "class", "state"):
            table.add_column(name)
        for name in ("before [m]", "now [m]", "grown by [m]", "counts [m]"):
            table.add_column(name, justify="right")
        for each in step.pipes:
            change = each.change
            lengths = (change.length_before, change.length_after, change.grown, change.counted)
            state = change.state.replace("_", " ")
            table.add_row(
                each.life, _name(change.class_name or "no planned class"), state, *(f"{m:.2f}" for m in lengths)
            )
        output_console().print(table)


def print_score(figures: dict[str, Any]) -> None:
    """The figures of `score` as tables."""
    console = output_console()
    console.print(_rates_table(figures))
    console.print(_confusion_table(figures["confusion"]))
    console.print(_errors_table(figures["pipes"]))
    for name, value, form, unit in _single_figures(figures):
        if value is not None:
            line = f"{for_terminal(name):<30} {_number(value, form):>10} {unit}"
            console.print(Text(line))
    for key in ("missed", "false"):
        if figures[key]:
            console.print(_name(f"{key}: {', '.join(figures[key])}"))


def _rates_table(figures: dict[str, Any]) -> Table:
    table = Table(title=f"Found and classified (aligned by {figures['alignment']})", title_justify="left")
    for name in ("", "true", "false", "missed", "precision", "recall", "F", "accuracy"):
        table.add_column(name, justify="right" if name else "left")
    titles = {"detection": "all detections", "planned": "of planned classes", "classification": "right class"}
    for key, title in titles.items():
        rates = figures[key]
        counts = (str(rates[name]) for name in ("true_positives", "false_positives", "false_negatives"))
        shares = (_number(rates[name], ".3f") for name in ("precision", "recall", "f_measure", "accuracy"))
        table.add_row(title, *counts, *shares)
    return table


def _confusion_table(confusion: dict[str, Any]) -> Table:
    table = Table(title="Pipes of each true class (rows) by the class found (columns)", title_justify="left")
    table.add_column("true \\ found")
    for label in confusion["labels"]:
        table.add_column(_name(label), justify="right")
    for label, counts in zip(confusion["labels"], confusion["matrix"], strict=True):
        table.add_row(_name(label), *map(str, counts))
    return table


def _errors_table(pipes: Sequence[dict[str, Any]]) -> Table:
    table = Table(title="Pipes", title_justify="left")
    for name in ("truth", "found", "class"):
        table.add_column(name)
    for name in (
        *("radius [mm]", "radius error [mm]", "in sigmas", "length [m]", "length error [%]", "in sigmas"),
        "off axis [mm]",
    ):
        table.add_column(name, justify="right")
    for pipe in pipes:
        measures = (
            (1e3 * pipe["true_radius"], ".1f"),
            (pipe["radius_error_mm"], "+.3f"),
            (pipe["radius_error_sigmas"], "+.1f"),
            (pipe["true_length"], ".3f"),
            (pipe["length_error_percent"], "+.2f"),
            (pipe["length_error_sigmas"], "+.1f"),
            (pipe["axis_distance_mm"], ".1f"),
        )
        cells = (_number(value, form) for value, form in measures)
        table.add_row(_name(pipe["truth"]), _name(pipe["id"]), _name(pipe["class"] or "none"), *cells)
    return table


def _single_figures(figures: dict[str, Any]) -> list[tuple[str, float | None, str, str]]:
    """Name, value (None: not known), format and unit of the figures that are no table."""
    single = [
        ("radius RMSE", figures["radius"]["rmse_mm"], ".3f", "mm"),
        ("radius within 3 sigma", figures["radius"]["within_3_sigma"], ".3f", "of the pipes"),
        ("length error, mean", figures["length"]["mean_error_percent"], ".2f", "%"),
        ("length within 3 sigma", figures["length"]["within_3_sigma"], ".3f", "of the pipes"),
        *((f"metres of {c['class']}", c["error_percent"], "+.2f", "%") for c in figures["length"]["per_class"]),
        ("scale error", figures["scale"]["error_percent"], "+.4f", "%"),
    ]
    if figures["trajectory"]:
        single += [
            ("camera positions, rigid", figures["trajectory"]["rms_rigid_mm"], ".2f", "mm rms"),
            ("camera positions, similarity", figures["trajectory"]["rms_similarity_mm"], ".2f", "mm rms"),
            ("worst camera, similarity", figures["trajectory"]["max_similarity_mm"], ".2f", "mm"),
        ]
    return single


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


def _name(name: str) -> Text:
    """A name from outside: no markup, no control characters."""
    return Text(for_terminal(name))


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
