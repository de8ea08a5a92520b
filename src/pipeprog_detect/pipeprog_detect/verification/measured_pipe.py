"""What the keyframes make of a candidate, and pieces of one pipe made one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.cloud.collinear import join, spanning
from pipeprog_detect.types import Cylinder

# Shorter than so many radii what the cloud does not resolve may be a hanger, a clamp, or chance.
SLENDER = 20.0


@dataclass(frozen=True)
class Measured:
    """A candidate after the images were asked: its cylinder and the standard deviation of its radius [m].

    `rims`: what the images say for a rim at its start and at its end (`rim.End.odds`).
    """

    candidate: Candidate
    cylinder: Cylinder
    radius_sigma: float
    rims: tuple[float, float] = (0.0, 0.0)


def joined(measured: Sequence[Measured]) -> list[Measured]:
    """Pieces of one pipe made one, as thick as the best measured: the cloud may show one, lines another."""
    whole = []
    for pieces in join([each.cylinder for each in measured]):
        best = min(pieces, key=lambda piece: measured[piece].radius_sigma)
        cylinder = spanning([measured[piece].cylinder for piece in pieces], best=pieces.index(best))
        points = sum(measured[piece].candidate.points for piece in pieces)
        along = sorted(
            (float(end @ cylinder.axis), rim)
            for piece in (measured[number] for number in pieces)
            for end, rim in zip((piece.cylinder.start, piece.cylinder.end), piece.rims, strict=True)
        )
        candidate, rims = replace(measured[best].candidate, points=points), (along[0][1], along[-1][1])
        whole.append(Measured(candidate, cylinder, measured[best].radius_sigma, rims))
    return whole


def is_stub(cylinder: Cylinder) -> bool:
    """Whether it is too short for a pipe that the cloud does not resolve."""
    return cylinder.length < SLENDER * cylinder.radius


def is_known(cylinder: Cylinder, known: Sequence[Cylinder]) -> bool:
    """Whether the middle of the cylinder lies within a known one."""
    return any(other.contains(cylinder.middle) for other in known)
