# SPDX-License-Identifier: Apache-2.0
"""One page an experiment, docs/results/*.md, from the JSON files in results/."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.markdown import bullets, cell, rows_table, table

Result = dict[str, Any]
Row = dict[str, Any]

WORTH_TELLING_MM = 1.0  # a radius further off is named with its pipe
WORTH_TELLING_PERCENT = 3.0  # and so is a length
NOT_SHOWN = ("commit", "why")  # columns that are given below the table
WHO = ("paper's figure", "paper's method", "its detection, our images", "ours")


@dataclass(frozen=True)
class Page:
    """One page.

    Attributes:
        heading: its first line.
        results: names of the JSON files that it shows.
        note: what a reader must know about them.
        pictures: files in docs/images, each with its caption.
        only: values of a row's first column that are shown; all where it is empty (a picture shows the others).
    """

    heading: str
    results: tuple[str, ...]
    note: str = ""
    pictures: tuple[tuple[str, str], ...] = ()
    only: tuple[int, ...] = ()


PAPERS_METHOD = (
    "`paper's method` is Algorithm 1 over the whole recording, sections of planes, radii of the cloud and k-means; "
    "mapper and dense cloud are ours in all columns.\n"
    "`its detection, our images` is the paper's detection (planes, radii of the cloud, k-means) on the clouds of "
    "`ours`.\n"
    "The settings of each are in the JSON files.\n"
    "Counts are means over the sites; rates and errors are of all their pipes together.\n"
    "A survey without a result counts all pipes as missed.\n"
    "Of the paper's figures only some are known here; what its tables other than 1, 2 and 5 hold is our reading.\n"
    "The paper filmed in 4K; `python -m benchmarks.experiments --size 4k` does the same and takes many hours.\n\n"
    "Why the paper's method stays behind the paper's own figures here: by Eq. 1 almost every image of this mapper is "
    "above the band, since its tie points span nearly all of the image.\n"
    "Algorithm 1 then keeps a handful of images, where the paper's kept dozens, and they see the pipes and the board "
    "from too few sides."
)

PAGES = {
    "fleet": Page(
        "A fleet's recordings on Dask",
        ("fleet_throughput", "fleet_kills", "fleet_kills_stand_in", "fleet_simulated"),
        "What `pipeprog fleet` does and what it costs: [fleet](../fleet.md).",
    ),
    "coverage": Page(
        "Seen and not seen",
        ("coverage",),
        "A third of the pipes are planned and not installed, and a third of the others count as missed by the detector."
        "\nThe cloud is what rays of the keyframes meet, with the noise of stereo and without the thinnest class.\n"
        "Out of sight is a pipe of which three keyframes see at most a tenth, in view one of which they see nine "
        "tenths; rightly told as missing can only be pipes thicker than 20 mm in radius.",
    ),
    "alignment": Page(
        "Surveys in the frame of an earlier one",
        ("alignment",),
        "The second night of a generated lab has a pipe more, one less and one longer, other light and clutter, and no "
        "board; other rooms are labs of other seeds, furnished alike.\n"
        "Images of 480 x 270 pixels through the sparse stage alone; the reference lies in the frame of the truth.\n"
        "The displacement is told at the wall behind the pipes, against the true poses of the second night.",
    ),
    "materials": Page(
        "Materials of pipes of one radius",
        ("materials",),
        "Each barrel is one of the bill's materials of its radius, the others are drawn out of all fourteen, also such "
        "as nobody tells apart (grey PVC and grey paint).\n"
        "Right is how often the likeliest of the bill's materials is the true one, without `cannot tell`.\n"
        "Generated racks are of seeds that the model was not trained on; path-traced ones were made with Blender's "
        "Cycles (three images of 480 x 270 pixels, materials and light of their own), and nothing was trained on them; "
        "that doubt is raised by half was chosen with seven of them in view.",
    ),
    "board_views": Page(
        "Experiment 1: the scale from few views of the board",
        ("board_views",),
        "For each number of views, 50 random choices of views in each site.\n"
        "The paper says that the correction for the circles' eccentricity halves the error, and that five views "
        "suffice.",
        (
            (
                "experiment_figure_8.png",
                "Figure 8: error over the number of views of the board, centres corrected or not",
            ),
        ),
        (2, 3, 4, 5, 7, 10, 15, 20, 25, 30, 35),
    ),
    "experiments_lab": Page(
        "Experiments on generated labs",
        ("experiment_table_1", "experiment_table_3", "experiment_table_4"),
        PAPERS_METHOD,
        (
            ("experiment_figure_9.png", "Figure 9: distances of the clouds from the true surfaces, over the overlap"),
            ("experiment_figure_10.png", "Figure 10: F, radius and length, over the overlap"),
        ),
    ),
    "experiments_field": Page(
        "Experiments on generated fields",
        ("experiment_table_2", "experiment_table_5", "experiment_table_6", "experiment_table_7"),
        f"{PAPERS_METHOD}\n\nThe paper's Table 5 gives its best field result as precision 93.1 % and recall 100 %, but "
        "its text says that 4 of 58 pipes were not identified; 54/58 is 93.1 %, so the two look swapped.\n"
        "F is 96.4 % either way.",
        (
            ("experiment_figure_11_ours.jpg", "Figure 11: the pipes of a field in their classes' colours, ours"),
            ("experiment_figure_11_paper.jpg", "Figure 11, the paper's method on the same recording"),
        ),
    ),
    "ablations": Page(
        "What each stage brings",
        ("ablations",),
        "Labs at 85 % overlap, with one stage left out at a time.\n"
        "What the correction for eccentricity is worth shows in the scale.\n"
        "Feedback and deblurring are made for walks less even than these: see [motions](motions.md) and "
        "[deblurring](deblur.md).",
    ),
    "joint_adjustment": Page(
        "Poses and pipes adjusted together",
        ("joint_adjustment",),
        "The outlines of all pipes as observations of the poses.\n"
        "`poses known to` is how firmly the points hold a pose, in pixels of its image; at 0 the poses stay.\n"
        "The points place the images to 0.02 to 0.16 px, and an edge of an outline has an error of 0.05 px that all "
        "edges of a line share: the more a pose may follow the outlines, the worse poses and radii get.\n"
        "So there is no option for it.\n"
        "Recordings with a rolling shutter, whose poses are less certain, have not been tried.",
    ),
    "cloud_accuracy": Page("Clouds against the true surfaces", ("cloud_accuracy",)),
    "convergence": Page(
        "How far off a start may be",
        ("convergence_cloud", "convergence_contour"),
        "The fit to the cloud, and the refinement by apparent contours at true poses, from starts that are off.",
    ),
    "peers": Page(
        "Other detectors on the same clouds",
        ("peers",),
        "Scanned clouds of generated sites, the same scorer for all.\n"
        "The peers' random choices cannot be seeded through their interfaces: their figures move a little from one "
        "measurement to the next.\n"
        "No CPU seconds: no answer within five minutes.",
    ),
    "peers_sfm": Page(
        "Poses and CPU time against batch COLMAP",
        ("peers_sfm",),
        "The same keyframes for both, with the calibration fixed.",
    ),
    "front_ends": Page(
        "The detector's two front ends",
        ("front_ends",),
        "Scanned sites; `normals` votes by local shape, `planes` is the paper's Algorithm 3, `straightened` the same "
        "with sections taken along the pipe.",
    ),
    "robustness": Page(
        "One factor of a recording at a time",
        ("robustness",),
        "A generated lab filmed for 7.5 m of way, 480p unless said.\n"
        "[How to film](../recording.md) has the advice that follows from each.",
        (("robustness.png", "F (bars) and radius error (line) for each factor"),),
    ),
    "scale_sigma": Page("The stated sigma of the scale against its true error", ("scale_sigma",)),
    "motions": Page("Motions that a selector must survive", ("motions",)),
    "deblur": Page("Motion blur undone", ("deblur",)),
    "sewer": Page(
        "Pipes seen from inside",
        ("sewer",),
        "Real clouds of PVC sewers with a nominal outer diameter; radius and length are of the longest pipe found.",
    ),
    "board_calibration": Page(
        "A camera from a film of a board",
        ("board_calibration",),
        "Hand-held films of 30 s, 720p at 30 Hz, noise, motion blur of 4 ms, read-out of 15 ms; the start is a focal "
        "length 5 % off, without distortion.\n"
        "The lens is compared over the whole image, after the turn of the camera that makes the difference least.",
    ),
    "cost": Page("Time and memory of the detector", ("cost",)),
    "map_growth": Page("Time of a keyframe as the map grows", ("map_growth",)),
    "descriptors": Page("SIFT descriptors beside OpenCV's", ("descriptors",)),
    "selector_cost": Page("Time of choosing keyframes", ("selector_cost",)),
    "stream_memory": Page("Memory of the frame selector", ("stream_memory",)),
    "keyframe_path": Page("The camera's path from keyframes and from all frames", ("keyframe_path",)),
}


def pages(results: Mapping[str, Result]) -> dict[str, tuple[str, str]]:
    """Heading and text of each page by its name; a result that no page names has a page of its own."""
    named = {name for page in PAGES.values() for name in page.results}
    every = dict(PAGES)
    for name, result in results.items():
        if name not in named and not name.startswith("survey_"):
            every[name] = Page(result.get("title", name.replace("_", " ").capitalize()), (name,))
    texts = {"recordings": ("Recordings through the graph", recordings_page(surveys(results)))}
    for name, page in every.items():
        known = {result: results[result] for result in page.results if result in results}
        if known:
            texts[name] = (page.heading, _page(page, known))
    return texts


def surveys(results: Mapping[str, Result]) -> dict[str, Result]:
    """The recordings that were surveyed and scored one by one, by their names."""
    return {name.removeprefix("survey_"): result for name, result in results.items() if name.startswith("survey_")}


def _page(page: Page, results: Mapping[str, Result]) -> str:
    commands = dict.fromkeys(result.get("command", f"python -m benchmarks.{name}") for name, result in results.items())
    parts = [_head(page.heading, commands)]
    parts += [f"{page.note}\n"] * bool(page.note)
    parts += [f"![{caption}](../images/{file})\n\n{caption}.\n" for file, caption in page.pictures]
    for name, result in results.items():
        parts += _section(result, page, name)
    parts.append(_measured(results))
    return "\n".join(parts)


def _section(result: Result, page: Page, name: str) -> list[str]:
    """One result: its title where page.note does not say it, findings, table, and what gave no result."""
    title = result.get("title", page.heading)
    said = title == page.heading or (len(page.results) == 1 and bool(page.note))
    parts = [] if said else [f"## {title}\n"]
    findings = result.get("findings") or result.get("summary")
    if findings:
        parts.append(bullets(f"{what.replace('_', ' ')}: {value}" for what, value in findings.items()))
    rows = [row for row in result["rows"] if not page.only or next(iter(row.values())) in page.only]
    if name.startswith("experiment_table_"):
        parts += _experiment(rows)
    else:
        parts.append(rows_table(rows, NOT_SHOWN))
    failed = [f"{row['factor']} {row['value']}: {row['why'].removeprefix('Error: ')}" for row in rows if "why" in row]
    if failed:
        parts.append(f"No result:\n\n{bullets(failed)}")
    return parts


def _experiment(rows: Sequence[Row]) -> list[str]:
    """A table of the paper: all methods at its highest overlap, then ours and its method over the overlap."""
    highest = max(row["overlap [%]"] for row in rows)
    quantities = list(dict.fromkeys(row["quantity"] for row in rows))
    values = {(row["quantity"], row["overlap [%]"]): row for row in rows}
    overlaps = sorted({row["overlap [%]"] for row in rows})

    def value(quantity: str, overlap: int, who: str) -> str:
        return cell(values.get((quantity, overlap), {}).get(who))

    best = [[quantity, *(value(quantity, highest, who) for who in WHO)] for quantity in quantities]
    parts = [f"At {highest} % overlap:\n", table(["quantity", *WHO], best)]
    for who in ("ours", "paper's method"):
        lines = [[quantity, *(value(quantity, overlap, who) for overlap in overlaps)] for quantity in quantities]
        parts += [f"{who.capitalize()}, over the overlap:\n", table(["quantity", *(f"{o} %" for o in overlaps)], lines)]
    return parts


def _measured(results: Mapping[str, Result]) -> str:
    """Where the figures are, and at which commits they were measured, where they say so."""
    files = ", ".join(f"[{name}.json](../../benchmarks/results/{name}.json)" for name in results)
    commits = sorted({commit for result in results.values() for commit in _commits(result)})
    return f"Figures: {files}" + (f"; measured at {', '.join(commits)}.\n" if commits else ".\n")


def _commits(result: Result) -> Iterable[str]:
    told = result.get("commits", [])
    every = [one for each in told.values() for one in each] if isinstance(told, dict) else told
    return {*every, *(row["commit"] for row in result["rows"] if "commit" in row)}


def _head(heading: str, commands: Iterable[str]) -> str:
    return f"# {heading}\n\n[Accuracy](../accuracy.md) / {heading}\n\n" + "".join(f"`{each}`\n" for each in commands)


def _false(survey: Result) -> str:
    return " / ".join(str(survey["score"][kind]["false_positives"]) for kind in ("planned", "detection"))


def _right(survey: Result) -> str:
    score = survey["score"]
    return f"{score['classification']['true_positives']} of {len(score['pipes']) + len(score['missed'])}"


def _chi_square(survey: Result) -> float:
    """Mean square of radius errors over their stated sigmas: 1 where the sigmas are true."""
    pipes, sigmas = survey["score"]["pipes"], survey["radius_sigmas"]
    return float(np.mean([(1e-3 * pipe["radius_error_mm"] / sigmas[pipe["id"]]) ** 2 for pipe in pipes]))


COLUMNS: dict[str, Callable[[Result], str]] = {
    "right class": _right,
    "false: planned / all": _false,
    "F": lambda survey: f"{survey['score']['classification']['f_measure']:.3f}",
    "radius RMSE": lambda survey: f"{survey['score']['radius']['rmse_mm']:.2f} mm",
    "length error": lambda survey: f"{survey['score']['length']['mean_error_percent']:.2f} %",
    "scale error": lambda survey: f"{survey['score']['scale']['error_percent']:+.4f} %",
    "cameras, rigid": lambda survey: f"{survey['score']['trajectory']['rms_rigid_mm']:.2f} mm",
    "chi2 of radius": lambda survey: f"{_chi_square(survey):.2f}",
    "wall / CPU time": lambda survey: f"{survey['wall_s']:.0f} / {survey['cpu_s']:.0f} s",
}


def recordings_page(known: Mapping[str, Result]) -> str:
    """Recordings replayed and scored one by one: figures, class totals, what fell short, commands."""
    rows = [[f"`{name}`", *(column(survey) for column in COLUMNS.values())] for name, survey in known.items()]
    parts = [_head("Recordings through the graph", ["python -m benchmarks.survey"])]
    parts += [
        "`lab` and `field` are sites of the generator in `bags/`, 720p: six pipes of five radii (8.6 to 109.5 mm), and "
        "58 pipes of six.\n`tiled0.5` has walls of one texture that repeats every 0.5 m.\n"
        '"Cameras, rigid" is the RMSE of the cameras\' positions after a rigid alignment, with the scale as published; '
        '"chi2 of radius" is the mean of (radius error / its sigma)², 1 where the sigmas are true.\n'
        "Times are of two cores without a GPU.\n",
        table(["recording", *COLUMNS], rows),
        "Total length of each class:\n",
        table(["recording", "class", "true [m]", "measured [m]", "error [%]"], list(_totals(known))),
        "What fell short:\n",
        bullets(_shortfalls(known)),
        "What the recordings are, and the commands:\n",
        bullets(_commands(known)),
    ]
    return "\n".join(parts)


def _totals(known: Mapping[str, Result]) -> Iterable[list[str]]:
    for name, survey in known.items():
        for entry in survey["score"]["length"]["per_class"]:
            metres = [f"{entry[key]:.3f}" for key in ("true_m", "measured_m")]
            yield [f"`{name}`", entry["class"], *metres, f"{entry['error_percent']:+.2f}"]


def _commands(known: Mapping[str, Result]) -> Iterable[str]:
    for name, survey in known.items():
        made = f"`{survey['made_by']}`; " if survey["made_by"] else ""
        yield f"`{name}`: {made}`{survey['command']}` at commit {survey['commit']}"


def _shortfalls(known: Mapping[str, Result]) -> Iterable[str]:
    """Every miss, every false detection and every pipe that is far off, in words."""
    for name, survey in known.items():
        score = survey["score"]
        faults = [f"pipe {pipe} missed" for pipe in score["missed"]]
        faults += [f"false detection {pipe}" for pipe in score["false"]]
        for pipe in score["pipes"]:
            what = f"pipe {pipe['truth']} ({1e3 * pipe['true_radius']:g} mm)"
            if abs(pipe["radius_error_mm"]) > WORTH_TELLING_MM:
                faults.append(f"{what} {pipe['radius_error_mm']:+.1f} mm in radius")
            if abs(pipe["length_error_percent"]) > WORTH_TELLING_PERCENT:
                faults.append(f"{what} {pipe['length_error_percent']:+.1f} % in length")
        if faults:
            yield f"`{name}`: {'; '.join(faults)}"
