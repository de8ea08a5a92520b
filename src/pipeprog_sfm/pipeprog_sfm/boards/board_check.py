"""Each circle of a placed board measured on its own, against what the board's file says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board_covariance import cauchy_weights
from pipeprog_sfm.boards.placed_board import PlacedBoard, circle_pixels, image_rows, project_rows
from pipeprog_sfm.config import BoardConfig

CONTRADICTION = 1e-4  # probability with which a sound board is taken for one that contradicts its file


@dataclass(frozen=True)
class BoardPlacement:
    """One board at one place of the model.

    Attributes:
        board: name of the board.
        scale: metres per model unit by this board alone.
        sigma: relative standard deviation of `scale`, from the images alone.
        ratio_scale: the same by the paper's Eq. 2, the ratio of the spreads of given and triangulated centres.
        model_from_board: (4, 4) similarity; takes metres to model units.
        views: stamps of the images used [ns].
        residuals_m: (N, 3) triangulated minus given centres in the board's frame, m; NaN for circles never seen twice.
        residual_sigmas_m: (N, 3) their standard deviations, m.
        residuals_px: (N,) root mean square reprojection error of each circle, px; NaN as above.
    """

    board: str
    scale: float
    sigma: float
    ratio_scale: float
    model_from_board: FloatArray
    views: tuple[int, ...]
    residuals_m: FloatArray
    residual_sigmas_m: FloatArray
    residuals_px: FloatArray


def measure(place: PlacedBoard, poses: Mapping[int, FloatArray], camera: Camera, config: BoardConfig) -> BoardPlacement:
    """Every circle triangulated on its own, and what it says against the file."""
    board, scale = place.board, place.scale
    rows = image_rows(place.views, poses, circle_pixels(place.views, place.model_from_board, poses, camera, config))
    residuals = np.full((len(board.centres), 3), np.nan)
    sigmas, pixels = residuals.copy(), residuals[:, 0].copy()
    noise = np.hypot(place.centre_sigma, place.pose_sigma)
    to_metres = place.model_from_board[:3, :3].T * scale**2  # its transpose is the rotation over the scale
    points = np.full((len(board.centres), 3), np.nan)
    for circle in range(len(board.centres)):
        own = rows.take(rows.circles == circle)
        if len(own.pixels) < 2:
            continue
        point = place.model_from_board[:3, :3] @ board.centres[circle] + place.model_from_board[:3, 3]
        for _ in range(10):
            projected, jacobian = project_rows(own, np.broadcast_to(point, (len(own.pixels), 3)), camera)
            error = (projected - own.pixels) / noise
            weights = np.sqrt(cauchy_weights(error))[:, None]
            flat = (jacobian / noise * weights[..., None]).reshape(-1, 3)
            change = np.linalg.lstsq(flat, -(error * weights).ravel(), rcond=1e-9)[0]
            point = point + change
        covariance = np.linalg.pinv(flat.T @ flat)
        points[circle] = point
        residuals[circle] = to_metres @ (point - place.model_from_board[:3, 3]) - board.centres[circle]
        sigmas[circle] = np.sqrt(np.diag(to_metres @ covariance @ to_metres.T))
        pixels[circle] = np.sqrt(np.mean(((projected - own.pixels) ** 2).sum(1)))
    known = ~np.isnan(residuals[:, 0])
    spreads = [np.linalg.norm(xyz[known] - xyz[known].mean(0)) for xyz in (board.centres, points)]
    return BoardPlacement(
        board.name,
        scale,
        place.sigma,
        float(spreads[0] / spreads[1]),
        place.model_from_board,
        tuple(view.stamp for view in place.views),
        residuals,
        sigmas,
        pixels,
    )


def contradiction(place: PlacedBoard, measured: BoardPlacement, config: BoardConfig) -> str:
    """Why the board is refused, or an empty text: a circle off by more than its sigma and the tolerance allow."""
    variance = measured.residual_sigmas_m**2 + config.tolerance**2
    distance = (measured.residuals_m**2 / variance).sum(1)
    known = ~np.isnan(distance)
    if not (distance[known] > chi2.ppf(1 - CONTRADICTION, 3)).any():
        return ""
    offsets = 1000 * np.linalg.norm(measured.residuals_m, axis=1)
    listed = ", ".join(f"{number + 1}: {offset:.2f} mm" for number, offset in enumerate(offsets) if known[number])
    return (
        f"board {place.board.name} contradicts its file (circles off by {listed}; they should be right to "
        f"{1000 * config.tolerance:g} mm): measure its centres again, check that it is flat and the file is its own, "
        "or walk slower past it if the camera has a rolling shutter"
    )
