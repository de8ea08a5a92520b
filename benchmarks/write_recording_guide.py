# SPDX-License-Identifier: Apache-2.0
"""The recording guide, docs/recording.md: what to do on site, each advice with what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.markdown import bullets, cell, table

Row = dict[str, Any]

HEAD = """# How to film

In short: walk slowly past the pipes at about two metres, sideways and not turning on the spot, with the board in view at the beginning and again at the end.
Keep the exposure short, focus and exposure fixed, stabilisation and sharpening off, and calibrate the camera at the size that it films in.

The tables below are of a generated lab (six pipes, 8.6 to 109.5 mm) filmed for 7.5 m of way at 480p, where a pipe of 8.6 mm at two metres is five pixels wide; one thing is spoiled at a time.
Rendered, not real: they show what a single fault costs, not what a site will give.

![F and radius error for each factor](images/robustness.png)
"""  # noqa: E501

# What to do, and why, for each factor; the figures come from the results.
ADVICE = {
    "resolution": (
        "Film as large as the camera can, and calibrate at that size.",
        "A radius follows from edges that are found to a fraction of a pixel, and a thin pipe must be several pixels "
        "wide to be seen at all.",
    ),
    "speed [m/s], phone with 4 ms and 15 ms": (
        "Walk at up to 0.75 m/s, slower where the exposure is longer than 4 ms.",
        "The phone of this table exposes for 4 ms and reads a frame out in 15 ms, which is not told.\n"
        "Blur grows with speed times exposure, skew with speed times read-out time, and a fast walk has fewer views of "
        "each pipe.\n"
        "At 0.2 m/s (2 Hz) the false pipe is a stub at the elbow of a DN65, and the read-out is found as 17 ms: "
        "keyframes half a second apart do not follow a hand.",
    ),
    "exposure [ms]": (
        "Fix the exposure at 1/500 s or less; bring light rather than expose longer.",
        "Blur along the walk widens the edges that lie across it.\n"
        "Undoing it (`--set sfm.deblur.exposure=0.008`, where the exposure is known) has helped only after jolts: see "
        "[deblurring](results/deblur.md).",
    ),
    "image noise [grey levels]": (
        "Rather noise than blur: raise the gain before the exposure time.",
        "Edges are averaged over hundreds of pixels and dozens of images, and noise averages out with them.",
    ),
    "JPEG quality": (
        "Record JPEG at a quality of 90 or more, video at the highest bit rate.",
        "Compression removes the fine texture by which images are matched before it moves an edge.",
    ),
    "distortion off, k1": (
        "Calibrate the lens; switch a phone's own correction off, or calibrate with it.",
        "k1 is the radial term that CameraInfo states wrongly here: 0.01 shifts a corner of the image by 3 pixels at "
        "480p, 0.05 is a camera whose distortion nobody has measured.",
    ),
    "focal length off [%]": (
        "Calibrate with fixed focus, and again after the camera has been dropped or refocused.",
        "The board corrects the scale where it hangs; away from it the map bends.",
    ),
    "texture, 1 is rich": (
        "On freshly painted walls have something with texture in view: floor, boxes, a few sheets of newspaper.",
        "The camera's path is found by textured surroundings; the pipes themselves need no texture.",
    ),
    "distance [m]": (
        "Stay about two metres away, nearer for pipes thinner than 20 mm.",
        "Nearer, an image shows less than the whole length of a pipe; farther away, a thin pipe is only a few pixels "
        "wide.",
    ),
    "share of the images lost": (
        "Record on the robot where the network is poor.",
        "Here half of eight images a second are lost at random: neighbouring keyframes must still overlap.",
    ),
    "rolling shutter [ms]": (
        "Prefer a camera with a global shutter; of a rolling one, as phones have, tell the read-out time where you "
        "know it (`--set sfm.readout=0.015`, or `readout` in the camera's file), and sway and turn a little as you "
        "walk.",
        "Rows of an image that are read at different times have different poses; a read-out that is not told is taken "
        "from the images, where the walk's changes of speed and direction tell it ([calibration](calibration.md)).\n"
        "A board that is skewed contradicts its file, and a scale that may be wrong is refused.\n"
        "This table is of 0.75 m/s at 4 Hz, not told.\n"
        "At 15 ms two DN65, 18 px wide and where they end as bright as the wall, lose their last 0.2 m, at 30 ms one "
        "of them, and the copper pipe 0.15 m. "
        "Camera paths are 0.2 mm off at 15 ms and 0.33 mm at 30 ms, where a global shutter's is 0.1 mm off.\n"
        "Seeds 127 and 128 (720p, 5 Hz), 0.75 m/s: 15 ms not told 6 of 6 with a radius RMSE of 0.103 mm, a scale "
        "0.000 % and a camera path 0.11 mm off; 30 ms not told 6 of 6 with 0.138 mm, 0.003 % and 0.13 mm; 30 ms told "
        "a fifth too long 6 of 6 with 0.113 mm, 0.004 % and 0.14 mm. With a global shutter the paths are 0.10 and "
        "0.06 mm off.\n"
        "Seed 129 (720p, 5 Hz), 20 ms at 1.4 m/s: told 6 of 6 with 0.078 mm, 0.002 % and a path 0.25 mm off; not told "
        "6 of 6 with 0.077 mm, 0.003 %, 0.29 mm and a read-out of 19.9 ms; told as 24 ms 6 of 6 with 0.083 mm, "
        "0.003 %, 0.36 mm and 20.1 ms; with a global shutter 6 of 6 with 0.091 mm, 0.002 % and 0.10 mm. What is left "
        "is the speed forwards, which five poses a second do not tell: where all that is seen lies at one depth, "
        "rolling rows show it as a turn upwards and a lift.\n"
        "These surveys take 1.2 to 1.6 times as long as with a global shutter, as more keyframes are taken.\n"
        "A field of 58 pipes (seed 125, 3 Hz), 15 ms at 0.72 m/s: told F 0.974, not told 0.965, with a global shutter "
        "0.973; its path is 0.56, 0.91 and 0.20 mm off, as 3 Hz do not follow a hand that sways at 1.7 Hz. At 5 Hz "
        "(seed 138) not told 1.000, with 0.087 mm, 0.003 % and a path 0.48 mm off.",
    ),
}
COLUMNS = ("right class", "false", "F", "radius RMSE [mm]", "length error [%]", "scale error [%]")


def guide(result: dict[str, Any] | None) -> str:
    """The text; a factor without a figure says so."""
    rows: Sequence[Row] = result["rows"] if result else ()
    parts = [HEAD]
    for factor, (what, why) in ADVICE.items():
        parts.append(f"## {factor[0].upper()}{factor[1:]}\n\n**{what}**\n{why}\n")
        measured = [row for row in rows if row["factor"] == factor]
        if not measured:
            parts.append("Not measured yet.\n")
            continue
        cells = [[f"**{row['value']}**", *(cell(row.get(column)) for column in COLUMNS)] for row in measured]
        parts.append(table(["", *COLUMNS], cells))
        failed = [
            f"{row['value']}: no result: {row['why'].removeprefix('Error: ')}" for row in measured if "why" in row
        ]
        parts += [bullets(failed)] * bool(failed)
        commits = sorted({row["commit"] for row in measured if "commit" in row})
        parts.append(f"Measured at commit {', '.join(commits)}.\n")
    command = result["command"] if result else "python -m benchmarks.robustness"
    return "\n".join([*parts, f"Measured by `{command}`, written by `python -m benchmarks.write_accuracy`.\n"])
