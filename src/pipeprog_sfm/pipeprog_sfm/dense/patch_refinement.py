# SPDX-License-Identifier: Apache-2.0
"""Sub-pixel depth: small slanted patches, compared with all neighbours at once and moved until they match.

Propagation of planes between pixels follows Bleyer, Rhemann and Rother, "PatchMatch stereo", 2011; the step to the
best match is Gauss-Newton on the zero-mean differences, as in Furukawa and Ponce's patches, 2010.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_sfm.dense.row_mapping import RowMapping, at_other_row, at_row

RADIUS = 2  # of a patch [px]: 5 x 5, smaller than the thinnest pipe at working distance
SIZE = (2 * RADIUS + 1) ** 2
COLUMNS = np.tile(np.arange(-RADIUS, RADIUS + 1, dtype=np.float32), 2 * RADIUS + 1)  # of a patch's pixels
ROWS = np.repeat(np.arange(-RADIUS, RADIUS + 1, dtype=np.float32), 2 * RADIUS + 1)
PLANE_RADIUS = 2  # grid pixels around one whose inverse depths give its slant
SAME_SURFACE = 0.01  # relative difference of depth up to which neighbouring pixels lie on one surface
CORRELATION_MIN = 0.3  # below, a view does not see the patch
MATCHED = 0.9  # signal of nine times the noise's power (correlation = S / (S + N)): no other plane is tried then
STEP_MAX = 0.004  # of the depth: linearisation of an image holds for about a pixel
SAME_PLANE = 0.0007  # of the depth, a fifth of STEP_MAX: Gauss-Newton takes planes this near to the same depth
GAIN_MIN, GAIN_MAX = 0.7, 1.4  # of one view's contrast over another's: exposure, viewing angle
NOISE = 0.7  # [grey levels] of two 8-bit images' difference at best
FLATNESS = 2e-4  # of the depth: how far a pipe of 50 mm bulges over the plane's 9 px at 2 m, 0.4 mm
# Square of the noise of a difference of neighbouring pixels, by that of a difference of two images: half of this is one
# image's, a difference has twice as much, and interpolation between two rows leaves two thirds.
DIFFERENCE_NOISE = 2.0 / 3.0
TEXTURE_MIN = 1.0 / 3.0  # of texture, in what texture and noise have together: with less, the noise makes the step
OVERLAP = (2 * RADIUS + 1) ** 2 / 4.0  # patches that share a pixel on a grid of stride 2: their errors go together
ROUNDS = (4, 2)  # distance in grid pixels at which each round takes over planes: beyond PLANE_RADIUS, on other data


def refine(
    inverse_depth: NDArray[np.float32],
    image: NDArray[np.float32],
    neighbours: NDArray[np.uint32],
    homographies: NDArray[np.float64],
    epipoles: NDArray[np.float64],
    stride: int,
    rows: RowMapping | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depth on a grid of every `stride`-th pixel of `image`, improved; its correlation; its relative sigma.

    `neighbours` (N, h, w) are the `fours` of N images. A pixel (u, v) of inverse depth i lies at
    homographies[n] @ (u, v, 1) + i * epipoles[n] of them; with rolling `rows` that is so at the stamps, and inverse
    depth is on the optical axis of each row's own pose.
    The correlation is the mean of the better half of the views, so that an occluded side does no harm; sigma follows
    from the patches' gradients and residuals. All outputs have the grid's shape; inverse depth NaN where unknown.
    """
    homographies, epipoles = homographies.astype(np.float32), epipoles.astype(np.float32)
    better_half = (len(neighbours) + 1) // 2
    correlation = np.zeros_like(inverse_depth)
    sigma = np.full_like(inverse_depth, FLATNESS)
    for distance in ROUNDS:
        inverse_depth, slant = _smooth(inverse_depth, sigma, stride)
        inverse_depth, correlation, sigma = _round(
            inverse_depth, slant, image, neighbours, homographies, epipoles, better_half, distance, stride, rows
        )
    return _smooth(inverse_depth, sigma, stride)[0], correlation, sigma


def fours(image: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(h, w) of an image: a pixel with those right of it, below and below right, from the lowest byte on.

    One load then gives what a place between pixels is interpolated from.
    """
    wide = image.astype(np.uint32)
    wide[:, :-1] |= wide[:, 1:] << np.uint32(8)
    wide[:-1] |= wide[1:] << np.uint32(16)
    return wide


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth(inverse_depth, sigma, stride):  # type: ignore[no-untyped-def]
    """Inverse depth drawn to the plane around it as far as its sigma demands, and its (h, w, 2) derivatives.

    Inverse depth is affine in the pixel on a plane. The plane is fitted with the weights 1 / sigma^2; it predicts the
    pixel with its own sigma and the FLATNESS of the surface, so what is well measured keeps its shape.
    """
    height, width = inverse_depth.shape
    smooth = inverse_depth.copy()
    slant = np.zeros((height, width, 2), np.float32)
    for v in range(height):
        sums, scratch = np.zeros((10, width), np.float32), np.empty((4, width), np.float32)
        for i in range(max(0, v - PLANE_RADIUS), min(height, v + PLANE_RADIUS + 1)):
            for shift in range(-PLANE_RADIUS, PLANE_RADIUS + 1):
                low, high = max(0, -shift), width - max(0, shift)
                _add_neighbours(
                    inverse_depth[v, low:high], inverse_depth[i, low + shift : high + shift],
                    sigma[i, low + shift : high + shift], np.float32(shift), np.float32(i - v), sums, low, scratch,
                )  # fmt: skip
        for u in range(width):
            centre = inverse_depth[v, u]
            if not centre > 0.0:
                continue
            n, su, sv, suu, suv, svv, sw, swu, swv, count = sums[:, u]
            cuu, cuv, cvv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            determinant = cuu * cvv - cuv * cuv
            if count >= 6 and determinant > 1e-3 * cuu * cvv:
                cwu, cwv = swu - sw * su / n, swv - sw * sv / n
                b, c = (cwu * cvv - cwv * cuv) / determinant, (cwv * cuu - cwu * cuv) / determinant
                slant[v, u, 0], slant[v, u, 1] = b / stride, c / stride
                own = sigma[v, u] * sigma[v, u]
                predicted = OVERLAP / n + FLATNESS * FLATNESS
                smooth[v, u] = centre + (sw - b * su - c * sv) / n * own / (own + predicted)
    return smooth, slant


@njit(cache=True, nogil=True, error_model="numpy")
def _add_neighbours(centres, others, sigmas, du, dv, sums, low, scratch):  # type: ignore[no-untyped-def]
    """Adds to a row's sums (10, width) the pixels (du, dv) away, where they lie on the same surface.

    The pixels in question are `low` and those after it, as many as there are `centres`; scratch (4, width).
    Loops over the row, each of few arrays, because the compiler makes vector code of these.
    """
    size = len(centres)
    same, away, weight, moment = scratch[0, :size], scratch[1, :size], scratch[2, :size], scratch[3, :size]
    for u in range(size):
        w = others[u] - centres[u]
        near = abs(w) < np.float32(SAME_SURFACE) * centres[u]
        same[u] = np.float32(1.0) if near else np.float32(0.0)
        away[u] = w if near else np.float32(0.0)
    for u in range(size):
        weight[u] = same[u] / (sigmas[u] * sigmas[u])
        moment[u] = weight[u] * away[u]
    for k, factor in enumerate((np.float32(1.0), du, dv, du * du, du * dv, dv * dv)):
        _add_times(weight, factor, sums[k, low : low + size])
    for k, factor in enumerate((np.float32(1.0), du, dv)):
        _add_times(moment, factor, sums[6 + k, low : low + size])
    _add_times(same, np.float32(1.0), sums[9, low : low + size])


@njit(cache=True, nogil=True, error_model="numpy")
def _add_times(values, factor, total):  # type: ignore[no-untyped-def]
    for u in range(len(total)):
        total[u] += values[u] * factor


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _round(inverse_depth, slant, image, neighbours, homographies, epipoles, better_half, distance, stride, rows):  # type: ignore[no-untyped-def]
    """Takes over the plane of a grid neighbour where it matches better, then one Gauss-Newton step of the depth.

    A pixel whose own plane has MATCHED keeps it.
    """
    height, width = inverse_depth.shape
    out = np.full((height, width), np.nan, np.float32)
    correlations = np.zeros((height, width), np.float32)
    sigmas = np.full((height, width), np.inf, np.float32)
    for row in range(height):
        v = row * stride
        if v < RADIUS or v >= image.shape[0] - RADIUS:
            continue
        patch = np.empty(SIZE, np.float32)
        scores = np.empty(len(neighbours), np.float32)
        turned, moved = np.empty((2, len(neighbours), 3), np.float32)
        for column in range(width):
            u = column * stride
            if u < RADIUS or u >= image.shape[1] - RADIUS or not inverse_depth[row, column] > 0.0:
                continue
            mean = np.float32(0.0)
            for k in range(SIZE):
                patch[k] = image[v + k // (2 * RADIUS + 1) - RADIUS, u + k % (2 * RADIUS + 1) - RADIUS]
                mean += patch[k]
            mean /= SIZE
            energy = np.float32(0.0)
            for k in range(SIZE):
                patch[k] -= mean
                energy += patch[k] * patch[k]
            if rows is not None:
                for n in range(len(neighbours)):
                    at_row(homographies[n], epipoles[n], rows, n, u, v, turned[n], moved[n])
            best_depth = best_step = best_sigma = np.float32(0.0)
            best = np.float32(-2.0)
            for candidate in range(5):
                i, j = row, column
                if candidate == 1:
                    j -= distance
                elif candidate == 2:
                    j += distance
                elif candidate == 3:
                    i -= distance
                elif candidate == 4:
                    i += distance
                if i < 0 or i >= height or j < 0 or j >= width or not inverse_depth[i, j] > 0.0:
                    continue
                su, sv = slant[i, j, 0], slant[i, j, 1]
                depth = inverse_depth[i, j] + (su * (column - j) + sv * (row - i)) * stride
                if candidate > 0 and abs(depth - best_depth) < np.float32(SAME_PLANE) * depth:
                    continue
                score, step, sigma = _match(
                    patch, energy, neighbours, homographies, epipoles, u, v, depth, su, sv, better_half, scores,
                    rows, turned, moved,
                )  # fmt: skip
                if score > best:
                    best_depth, best, best_step, best_sigma = depth, score, step, sigma
                if best > np.float32(MATCHED):
                    break
            if best_sigma > 0.0:
                limit = np.float32(STEP_MAX) * best_depth
                out[row, column] = best_depth + min(max(best_step, -limit), limit)
                correlations[row, column] = best
                sigmas[row, column] = best_sigma / best_depth
    return out, correlations, sigmas


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _match(  # type: ignore[no-untyped-def]
    patch, energy, neighbours, homographies, epipoles, u, v, depth, su, sv, better_half, scores, rows, turned, moved,
):  # fmt: skip
    """Mean correlation over the better half of the views, Gauss-Newton step of the inverse depth, sigma (0: unseen).

    `patch` (SIZE,) is the reference's patch less its mean, `energy` the sum of its squares; `neighbours` (N, h, w)
    hold four pixels each (`fours`).
    """
    one, size = np.float32(1.0), np.float32(SIZE)
    gradient, curvature, squared_shift = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    residual, used = np.float32(0.0), 0
    height, width = neighbours.shape[1:]
    pixels = neighbours.reshape(len(neighbours), height * width)
    for n in range(len(neighbours)):
        scores[n] = -1.0
        h = homographies[n]
        if rows is None:
            ex, ey, ez = epipoles[n, 0], epipoles[n, 1], epipoles[n, 2]
            z = h[2, 0] * u + h[2, 1] * v + h[2, 2] + ez * depth
            x = h[0, 0] * u + h[0, 1] * v + h[0, 2] + ex * depth
            y = h[1, 0] * u + h[1, 1] * v + h[1, 2] + ey * depth
        else:
            x, y, z, ex, ey, ez = at_other_row(turned[n], moved[n], rows, n, depth)
        z = one / z
        x *= z
        y *= z
        # The plane-induced homography is affine over so small a patch. Its rows turn it by 0.01 rad at most, 0.02 px
        # at its border: these derivatives are those of the stamps.
        zu, zv = h[2, 0] + ez * su, h[2, 1] + ez * sv
        xu, xv = (h[0, 0] + ex * su - x * zu) * z, (h[0, 1] + ex * sv - x * zv) * z
        yu, yv = (h[1, 0] + ey * su - y * zu) * z, (h[1, 1] + ey * sv - y * zv) * z
        dx, dy = (ex - ez * x) * z, (ey - ez * y) * z
        reach_x, reach_y = RADIUS * (abs(xu) + abs(xv)), RADIUS * (abs(yu) + abs(yv))
        inside = x - reach_x >= 0.0 and y - reach_y >= 0.0
        if not (inside and x + reach_x < width - 1 and y + reach_y < height - 1):
            continue
        across, down = (x, xu, xv, dx), (y, yu, yv, dy)
        sw, sc, ww, wp, cc, cp, cw = _moments(patch, pixels[n], np.int32(width), across, down)
        ww = max(ww - sw * sw / size, np.float32(0.0))
        cc -= sc * sc / size
        cw -= sc * sw / size
        correlation = wp / np.sqrt(ww * energy + np.float32(1e-6))
        scores[n] = correlation
        if correlation < CORRELATION_MIN:
            continue
        gain = min(max(np.sqrt(energy / (ww + np.float32(1e-6))), np.float32(GAIN_MIN)), np.float32(GAIN_MAX))
        gradient += gain * (cp - gain * cw)
        curvature += gain * gain * cc
        squared_shift += gain * gain * (dx * dx + dy * dy)
        residual += energy - np.float32(2.0) * gain * wp + gain * gain * ww
        used += 1
    total = _sum_of_best(scores, better_half)
    if used == 0 or not curvature > 0.0:
        return np.float32(-1.0), np.float32(0.0), np.float32(0.0)
    noise = max(residual, np.float32(0.0)) / np.float32(used * SIZE)
    # The derivatives are differences of noisy pixels: what their noise adds to the curvature shortens the step (errors
    # in variables; Fuller, Measurement Error Models, 1987).
    texture = curvature - np.float32(DIFFERENCE_NOISE * SIZE) * noise * squared_shift
    texture = max(texture, np.float32(TEXTURE_MIN) * curvature)
    # Sigma is that of the step as it would be without such noise: in noisy images SIGMA_MAX would leave no surface.
    sigma = np.sqrt((noise + np.float32(NOISE * NOISE)) / curvature)
    return total / np.float32(better_half), gradient / texture, sigma


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _moments(patch, pixels, width, across, down):  # type: ignore[no-untyped-def]
    """Sums over a patch (SIZE,) of w, c, ww, wp, cc, cp, cw: w the warped view, c its change with the inverse depth.

    The loop stores nothing, so that the compiler makes vector code of it. w is taken less the pixel at the centre: the
    sums stay so small that their differences are exact enough in float32. `pixels` (h * w,) hold four pixels each.
    `across`, `down`: column and row of the patch's centre in the view, and their derivatives by the patch's column and
    row and by the inverse depth.
    """
    x, xu, xv, dx = across
    y, yu, yv, dy = down
    level = np.float32(np.int32(pixels[np.uint32(np.int32(np.int32(y) * width) + np.int32(x))] & np.uint32(255)))
    sw, sc, ww, wp = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    cc, cp, cw = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(SIZE):
        j, i = COLUMNS[k], ROWS[k]
        px, py = x + xu * j + xv * i, y + yu * j + yv * i
        ix, iy = np.int32(px), np.int32(py)
        fx, fy = px - np.float32(ix), py - np.float32(iy)
        four = pixels[np.uint32(np.int32(iy * width) + ix)]
        top_left = np.float32(np.int32(four & np.uint32(255)))
        top_slope = np.float32(np.int32(np.uint32(four >> np.uint32(8)) & np.uint32(255))) - top_left
        bottom_left = np.float32(np.int32(np.uint32(four >> np.uint32(16)) & np.uint32(255)))
        bottom_slope = np.float32(np.int32(np.uint32(four >> np.uint32(24)))) - bottom_left
        top = top_left + top_slope * fx
        fall = bottom_left + bottom_slope * fx - top
        w = top + fall * fy - level
        c = (top_slope + (bottom_slope - top_slope) * fy) * dx + fall * dy
        p = patch[k]
        sw += w
        sc += c
        ww += w * w
        wp += w * p
        cc += c * c
        cp += c * p
        cw += c * w
    return sw, sc, ww, wp, cc, cp, cw


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _sum_of_best(scores, count):  # type: ignore[no-untyped-def]
    """Sum of the `count` highest scores, which are overwritten."""
    total = np.float32(0.0)
    for _ in range(count):
        top_view = 0
        for n in range(1, len(scores)):
            if scores[n] > scores[top_view]:
                top_view = n
        total += scores[top_view]
        scores[top_view] = -2.0
    return total
