"""A pinhole camera, and how to place it so that given points are in the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

__all__ = ["Camera"]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in a world with y up, in metres."""

    position: tuple[float, float, float]
    """Position of the camera."""
    target: tuple[float, float, float]
    """Point in the middle of the picture."""
    fov_rad: float = math.radians(24)
    """Angle of view along the height of the picture; small, so that limbs keep their proportions."""

    @classmethod
    def framing(
        cls,
        points: np.ndarray,
        *,
        aspect: float = 1.0,
        azimuth_rad: float = math.radians(28),
        elevation_rad: float = math.radians(9),
        fov_rad: float = math.radians(24),
        margin: float = 0.07,
    ) -> Camera:
        """Place a camera so that all points are in the picture, centred and as large as they can be.

        Args:
            points: [N, 3] metres; the corners of a box or all vertices of a sequence.
            aspect: width over height of the picture.
            azimuth_rad: direction of the camera seen from the points: 0 is +z, a quarter turn +x.
            elevation_rad: how far the camera looks down.
            fov_rad: angle of view along the height of the picture.
            margin: share of the picture that stays empty on each side.

        Raises:
            ValueError: there are no points, or they are not finite.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(points) or not np.isfinite(points).all():
            bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
            raise ValueError(f"points: wanted at least one finite point [N, 3], got {len(points)}, {bad} of them not finite")
        cos_elevation = math.cos(elevation_rad)
        backward = np.array(
            [math.sin(azimuth_rad) * cos_elevation, math.sin(elevation_rad), math.cos(azimuth_rad) * cos_elevation]
        )
        right, up = _right_up(backward)
        target = (points.min(axis=0) + points.max(axis=0)) / 2
        slope_y = math.tan(fov_rad / 2) * (1 - 2 * margin)
        slope_x = slope_y * aspect
        # In perspective near points spread more than far ones, so the middle is found by iteration; after four rounds the
        # error is well below a pixel.
        for _ in range(4):
            offset = points - target
            x, y, z = offset @ right, offset @ up, offset @ backward
            distance = max(float((z + np.maximum(np.abs(x) / slope_x, np.abs(y) / slope_y)).max()), 1e-3)
            depth = np.maximum(distance - z, 1e-6)
            middle = [(np.min(v / depth) + np.max(v / depth)) / 2 * distance for v in (x, y)]
            target = target + middle[0] * right + middle[1] * up
        near = cls(_triple(target + backward), _triple(target), fov_rad)
        return near.at(near.distance_to_see(points, aspect=aspect, margin=margin))

    def distance_to_see(self, points: np.ndarray, *, aspect: float = 1.0, margin: float = 0.07) -> float:
        """Return the distance from the target, metres, at which all points [N, 3] are in the picture; see `framing`."""
        slope_y = math.tan(self.fov_rad / 2) * (1 - 2 * margin)
        x, y, z = self.axes @ (np.asarray(points, dtype=np.float64) - self.target).T
        return max(float((z + np.maximum(np.abs(x) / (slope_y * aspect), np.abs(y) / slope_y)).max()), 1e-3)

    def at(self, distance: float) -> Camera:
        """Return the camera at another distance from its target, metres."""
        return replace(self, position=_triple(self.target + distance * self.axes[2]))

    def between(self, position: np.ndarray, target: np.ndarray) -> Camera:
        """Return the camera at another position [3] with another target [3], metres."""
        return replace(self, position=_triple(position), target=_triple(target))

    @property
    def axes(self) -> np.ndarray:
        """[3, 3] rows: right, up and backward (towards the viewer) in world coordinates."""
        backward = np.subtract(self.position, self.target, dtype=np.float64)
        length = np.linalg.norm(backward)
        if not length > 0:
            raise ValueError(f"camera: wanted different points as position and target, got {self.target} for both")
        backward = backward / length
        return np.stack([*_right_up(backward), backward])

    def project(self, points: np.ndarray, width: int, height: int) -> np.ndarray:
        """Return pixel coordinates (x to the right, y down) and depth in metres of points [N, 3], as [N, 3]."""
        local = (np.asarray(points, dtype=np.float64) - self.position) @ self.axes.T
        depth = -local[:, 2]
        focal = height / 2 / math.tan(self.fov_rad / 2)
        safe = np.where(depth > 1e-9, depth, 1e-9)
        return np.stack([width / 2 + focal * local[:, 0] / safe, height / 2 - focal * local[:, 1] / safe, depth], axis=1)

    def rays(self, x: np.ndarray, y: np.ndarray, width: int, height: int) -> np.ndarray:
        """Return unit directions [R * C, 3] float32, row by row, through pixel columns x [C] and rows y [R]."""
        focal = height / 2 / math.tan(self.fov_rad / 2)
        right, up, backward = self.axes
        across = ((x - width / 2) / focal)[:, None]
        upward = ((height / 2 - y) / focal)[:, None]
        directions = (across * right - backward).astype(np.float32) + (upward * up).astype(np.float32)[:, None]
        length = np.sqrt((across.T**2 + 1).astype(np.float32) + (upward**2).astype(np.float32))
        directions /= length[..., None]
        return directions.reshape(-1, 3)


def _triple(point: np.ndarray) -> tuple[float, float, float]:
    """Return a point [3] as three floats."""
    x, y, z = map(float, point)
    return x, y, z


def _right_up(backward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors to the right and up of a camera that looks along -backward."""
    right = np.cross((0.0, 1.0, 0.0), backward)
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])  # straight up or down
    return right, np.cross(backward, right)
