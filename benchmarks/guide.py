"""The recording guide, docs/recording.md: what to do on site, each advice with what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Row = dict[str, Any]

HEAD = """# How to film

Written by `python -m benchmarks.document` from `benchmarks/results/robustness.json`: a generated lab (six pipes, 8.6 to
109.5 mm) filmed for 7.5 m of way, one thing spoiled at a time, through the node graph. 480p unless said, where a pipe
of 8.6 mm at two metres is five pixels wide.
Rendered, not real: take the tables for what a single fault costs, not for what a site will give.

In short: walk slowly past the pipes at about two metres, sideways and not turning on the spot, the board in view at the
beginning and again at the end; short exposure, focus and exposure fixed, stabilisation and sharpening off; calibrate
the camera at the size that it films in.

![F and radius error for each factor](images/robustness.png)
"""

# What to do, and why, for each factor; the figures come from the results.
ADVICE = {
    "resolution": (
        "Film as large as the camera can, and calibrate at that size.",
        "A radius follows from outlines that are found to a share of a pixel, and a thin pipe must be several pixels "
        "wide to be seen at all.",
    ),
    "speed [m/s], phone with 4 ms and 15 ms": (
        "Walk slowly: 0.2 m/s with a phone, no faster than a stroll with a global shutter in good light.",
        "What costs is blur and skew, which grow with speed times exposure and speed times read-out; what a fast walk "
        "costs besides is views of each pipe.",
    ),
    "exposure [ms]": (
        "Fix the exposure at 1/500 s or less; bring light rather than time.",
        "Blur along the walk widens outlines across it. If the exposure is known, tell it: `--set "
        "sfm.deblur.exposure=0.008`.",
    ),
    "image noise [grey levels]": (
        "Rather noise than blur: raise the gain before the exposure time.",
        "Outlines are averaged over hundreds of pixels and dozens of images, and so noise averages out.",
    ),
    "JPEG quality": (
        "Record JPEG at a quality of 90 or more, video at the highest bit rate.",
        "Compression takes away the fine texture that ties images together before it moves an edge.",
    ),
    "distortion off, k1": (
        "Give the distortion of the lens; a phone's correction must be either off or calibrated with.",
        "k1 is the radial term that CameraInfo states wrongly: 0.01 shifts a corner by some 3 pixels at 480p, "
        "0.05 is a camera whose distortion nobody has measured.",
    ),
    "focal length off [%]": (
        "Calibrate with fixed focus, and again after the camera has been dropped or refocused.",
        "The board corrects the scale where it hangs; the shape of the map bends away from it.",
    ),
    "texture, 1 is rich": (
        "On freshly painted walls leave something in view that has texture: floor, boxes, a few sheets of newspaper.",
        "The camera's way is found by textured surroundings; the pipes' outlines need none.",
    ),
    "distance [m]": (
        "Stay about two metres away, nearer for pipes thinner than 20 mm.",
        "Too near, and an image shows too little of anything else; too far, and thin pipes fade into a few pixels.",
    ),
    "rolling shutter [ms]": (
        "Prefer a camera with a global shutter; with a rolling one, as phones have, walk at 0.2 m/s.",
        "Lines of an image that are read at different times belong to different poses; the map takes them for one. A "
        "board that is skewed by this contradicts its file, and a scale that may be wrong is refused. The table is of "
        "0.75 m/s; slower ones are under speed.",
    ),
}
COLUMNS = ("right class", "false", "F", "radius RMSE [mm]", "length error [%]", "scale error [%]")


def guide(result: dict[str, Any] | None) -> str:
    """The text; a factor without a figure says so."""
    rows: Sequence[Row] = result["rows"] if result else ()
    parts = [HEAD]
    for factor in ADVICE:
        what, why = ADVICE[factor]
        parts.append(f"## {factor[0].upper()}{factor[1:]}\n\n**{what}** {why}\n")
        measured = [row for row in rows if row["factor"] == factor]
        if not measured:
            parts.append("Not measured yet.\n")
            continue
        parts.append(_line(["", *COLUMNS]) + _line(["---"] * (1 + len(COLUMNS))) + "".join(map(_row, measured)))
        failed = [f"{row['value']}: no result ({row['why']})" for row in measured if "why" in row]
        parts += [f"{'; '.join(failed)}\n"] * bool(failed)
    command = result["command"] if result else "python -m benchmarks.robustness"
    return "\n".join([*parts, f"`{command}`\n"])


def _row(row: Row) -> str:
    cells = [row.get(column) for column in COLUMNS]
    return _line([f"**{row['value']}**", *("-" if cell is None else str(cell) for cell in cells)])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |\n"
