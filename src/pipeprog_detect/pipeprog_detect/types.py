# SPDX-License-Identifier: Apache-2.0
"""What the detector takes and returns: clouds, views, cylinders, pipes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage


@dataclass(frozen=True)
class Cloud:
    """A metric point cloud: points (N, 3) float64 [m]; normals (N, 3) float64 unit, towards the sensor, or None."""

    points: FloatArray
    normals: FloatArray | None = None


@dataclass(frozen=True)
class View:
    """One keyframe: grey image (H, W) uint8 of the ideal pinhole camera (already undistorted), and its pose.

    Pixels are those of the stamp, at which a camera with a rolling shutter exposes its middle row: `rolled` tells where
    the image shows them, None: there. `nearest` (h, w) float32, where it is known: depth [m] of what the cloud shows in
    each of h x w equal cells. `blur`, where it is known: that of the image by lens, pixel and motion together, as a
    standard deviation [px]. `chromaticity` (H, W) uint8: the colour of the pixels without their
    brightness (`red_against_blue`); None where they have none.
    """

    stamp: int
    image: NDArray[np.uint8]
    camera: Camera
    camera_from_map: FloatArray
    nearest: NDArray[np.float32] | None = None
    rolled: RolledImage | None = None
    blur: float | None = None
    chromaticity: NDArray[np.uint8] | None = None

    @cached_property
    def centre(self) -> FloatArray:
        """The projection centre (3,) in the map frame [m]."""
        rotation = self.camera_from_map[:3, :3]
        return -rotation.T @ self.camera_from_map[:3, 3]

    def in_colour(self) -> View | None:
        """The view with its colour in place of grey, how blurred is not known; None where it has no colour."""
        return None if self.chromaticity is None else replace(self, image=self.chromaticity, blur=None)

    @property
    def is_in_colour(self) -> bool:
        """Whether it has its colour in place of grey."""
        return self.image is self.chromaticity

    def shown(self, pixels: FloatArray, depths: FloatArray) -> FloatArray:
        """Where the image shows (N, 2) what lies at pixels (N, 2) at depths (N,) [m]."""
        return pixels if self.rolled is None else self.rolled.shown(pixels, depths)

    @cached_property
    def geometry(self) -> FloatArray:
        """camera_from_map by rows (12), fx, fy, cx, cy, width, height and the projection centre (21,)."""
        camera = self.camera
        lens = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
        return np.concatenate([self.camera_from_map[:3].ravel(), lens, self.centre])


@dataclass(frozen=True)
class Cylinder:
    """A finite circular cylinder: ends of its axis (3,) [m] and its radius [m]."""

    start: FloatArray
    end: FloatArray
    radius: float

    @cached_property
    def length(self) -> float:
        """Distance between the ends [m]."""
        return float(np.linalg.norm(self.end - self.start))

    @cached_property
    def axis(self) -> FloatArray:
        """Unit vector (3,) from start to end."""
        return (self.end - self.start) / self.length

    @cached_property
    def row(self) -> FloatArray:
        """Start, axis, length and radius (8,)."""
        return np.concatenate([self.start, self.axis, [self.length, self.radius]])

    @cached_property
    def middle(self) -> FloatArray:
        """The point (3,) of the axis halfway between the ends [m]."""
        return 0.5 * (self.start + self.end)

    def at(self, shares: NDArray[np.floating]) -> FloatArray:
        """Points (N, 3) on the axis at shares (N,) of the length from the start, 0 to 1 between the ends."""
        return np.asarray(self.start + shares[:, None] * (self.end - self.start), np.float64)

    def along(self, points: NDArray[np.floating]) -> FloatArray:
        """Positions (N,) of points (N, 3) along the axis, from the start [m]."""
        return np.asarray((points - self.start) @ self.axis)

    def from_axis(self, points: NDArray[np.floating]) -> FloatArray:
        """Vectors (N, 3) from the axis, endless, straight to points (N, 3) [m]."""
        offset = points - self.start
        return offset - (offset @ self.axis)[:, None] * self.axis

    def surface_distance(self, points: NDArray[np.floating]) -> FloatArray:
        """Signed distances (N,) of points (N, 3) from the endless surface, negative within [m]."""
        return np.linalg.norm(self.from_axis(points), axis=1) - self.radius

    def contains(self, point: FloatArray) -> bool:
        """Whether a point (3,) lies within."""
        along = float((point - self.start) @ self.axis)
        off_axis = point - self.start - along * self.axis
        return 0.0 < along < self.length and float(off_axis @ off_axis) < self.radius**2

    def cut(self, low: float, high: float) -> Cylinder:
        """The part between two positions along the axis, from the start [m]; they may lie beyond the ends."""
        return Cylinder(self.start + low * self.axis, self.start + high * self.axis, self.radius)

    def lengthened(self, at_end: bool, by: float) -> Cylinder:
        """The cylinder, longer `by` [m] at its end, or at its start; shorter where that is negative."""
        return self.cut(0.0, self.length + by) if at_end else self.cut(-by, self.length)

    def cut_like(self, other: Cylinder) -> Cylinder:
        """The part between the projections of another cylinder's ends on the axis."""
        low, high = sorted(float((end - self.start) @ self.axis) for end in (other.start, other.end))
        return self.cut(low, high)

    def shifted(self, by: FloatArray) -> Cylinder:
        """The cylinder moved by a vector (3,) [m]."""
        return Cylinder(self.start + by, self.end + by, self.radius)


# free: the images show where the barrel ends; fitting, wall: it ends there; hidden: something hides what follows from
# all cameras; out_of_view: no image reaches further; unknown: measured in the cloud alone.
END_STATES = ("free", "fitting", "wall", "hidden", "out_of_view", "unknown")


@dataclass(frozen=True)
class PipeEnd:
    """An end of a pipe.

    Attributes:
        sigma: standard deviation of its place along the axis [m]; NaN where it is not known.
        state: what is there, one of `END_STATES`.
    """

    sigma: float = float("nan")
    state: str = "unknown"


@dataclass(frozen=True)
class Pipe:
    """A measured and classified pipe; fields as in pipeprog_msgs/Pipe (metres, radians).

    `class_kmeans` depends on the radii of all pipes of a map: it is empty until these are known. `ends`: its start and
    its end. `material`: what the keyframes show it to be made of, where classes of its radius differ in that; empty
    where they do not tell, and with a probability of 0 where they were not asked.
    """

    id: str
    cylinder: Cylinder
    radius_sigma: float
    class_name: str | None
    class_probability: float
    visible_arc: float
    rmse: float
    points: int
    class_kmeans: str = ""
    ends: tuple[PipeEnd, PipeEnd] = (PipeEnd(), PipeEnd())
    material: str = ""
    material_probability: float = 0.0
