# SPDX-License-Identifier: Apache-2.0
"""A results folder as pandas tables: metres a class, and how sure each radius is.

    python examples/read_results_into_pandas.py out/demo      (after `make demo`)

pandas is not among pipeprog's dependencies: pip install pandas.
"""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd

import pipeprog


def tables(folder: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The pipes, one a row, and what is installed of each class."""
    results = pipeprog.read_results(folder)
    pipes = pd.DataFrame(results.pipes).set_index("id")
    ends = np.array([[cylinder.start, cylinder.end] for cylinder in results.cylinders])
    pipes["height"] = ends[:, :, 2].mean(axis=1)
    pipes["sigmas_from_plan"] = (pipes["radius"] - pipes["class"].map(_planned(results))) / pipes["radius_sigma"]
    classes = pipes.groupby("class")["length"].agg(["count", "sum"])
    return pipes, classes


def _planned(results: pipeprog.Results) -> dict[str, float]:
    """Planned outer radius [m] of each class."""
    return {entry["class"]: entry["outer_radius"] for entry in results.classes}


def main() -> None:
    """Prints both tables."""
    pipes, classes = tables(sys.argv[1])
    print(pipes[["class", "radius", "radius_sigma", "sigmas_from_plan", "length", "height"]].round(4).to_string())
    print(classes.round(3).to_string())


if __name__ == "__main__":
    main()
