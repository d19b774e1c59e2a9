"""The floor below a body, the backdrop that it fades to, and the shadow of the body on it.

DESIGN. The floor is an analytic plane. All but the shadow depends on the camera alone, so for a fixed camera it is computed
once. The shadow is computed on a coarse grid around the body, and changes only the pixels that see this part of the floor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from snarfcli.rendering.camera import Camera
from snarfcli.rendering.lighting import PATTERN, LitScene, Look

__all__ = ["Backdrop", "Floor"]

_CELLS = 112  # shadow grid, each way: 2 to 3 cm for a standing body
_LINE_SHARE = 0.014  # width of a line of the floor's pattern over its spacing
_LINE_SHADE = 0.17  # how much darker a line is: visible in motion, but not distracting


@dataclass(frozen=True)
class Floor:
    """Height and pattern of the floor."""

    height: float
    """Metres."""
    spacing: float | None = None
    """Metres between the lines of a faint pattern, which makes motion visible; None for a plain floor."""


class Backdrop:
    """The empty stage seen by one camera, as the background of pictures of one size."""

    def __init__(self, camera: Camera, size: tuple[int, int], floor: Floor, look: Look) -> None:
        self.camera, self.size, self.floor, self.look = camera, size, floor, look
        width, height = size
        x, y = np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5
        view = camera.rays(x, y, width, height)
        position, target = (np.asarray(place, dtype=np.float32)[[0, 2]] for place in (camera.position, camera.target))
        above = np.float32(camera.position[1] - floor.height)
        meets = (view[:, 1] < -1e-4) & (above > 0)
        distance = np.where(meets, above / np.where(meets, -view[:, 1], 1), np.float32(1e6))
        # Relative to the target, so that float32 is precise.
        away = view[:, [0, 2]] * distance[:, None] + (position - target)
        # The light fades into the backdrop, so that there is no horizon.
        reach = np.float32(np.linalg.norm(np.subtract(camera.position, camera.target)))
        fade = np.clip((np.sqrt(away[:, 0] ** 2 + away[:, 1] ** 2) / reach - np.float32(0.12)) / np.float32(0.75), 0, 1)
        fade = np.where(meets, fade * fade * (3 - 2 * fade), 1)[:, None]
        distant = np.asarray(look.backdrop, dtype=np.float32) * (1.02 - 0.10 * (y / height)).repeat(width)[:, None] * fade
        lit = np.asarray(look.floor, dtype=np.float32) * (1 - fade)
        if floor.spacing is not None:
            lit *= (1 - _LINE_SHADE * _lines(away.reshape(height, width, 2), target, floor.spacing)).reshape(-1, 1)
        self._place = away
        self._target = target.astype(np.float64)
        self._empty = (lit + distant).astype(np.float32)
        # Light lost in full shadow; none far away, where the floor fades.
        self._drop = (lit + distant * (1 - fade)).astype(np.float32)

    def picture(self, scene: LitScene | None) -> np.ndarray:
        """Return the stage [H * W, 3] float32, linear colour, with the shadow of the scene on the floor."""
        picture = self._empty.copy()
        if scene is None:
            return picture
        light, lower, cell = _shadow(scene)
        spot = self._place + (self._target - lower).astype(np.float32)
        size = (cell * _CELLS).astype(np.float32)
        shaded = np.flatnonzero(((spot >= 0) & (spot <= size)).all(axis=1))
        spot = spot[shaded] / cell.astype(np.float32) - np.float32(0.5)
        lost = 1 - map_coordinates(light, spot.T, order=1, mode="nearest")
        picture[shaded] -= lost[:, None] * self._drop[shaded]
        return picture


def _lines(away: np.ndarray, target: np.ndarray, spacing: float) -> np.ndarray:
    """Return the share of each pixel [H, W] covered by a grid of lines, box-filtered so that far lines do not flicker."""
    half = np.float32(spacing * _LINE_SHARE / 2)
    cover = np.zeros(away.shape[:2], dtype=np.float32)
    for axis in range(2):
        place = away[..., axis]
        # Width of a pixel on the floor, across these lines.
        wide = sum(np.abs(step) for step in np.gradient(place)) if min(place.shape) > 1 else np.full_like(place, spacing)
        wide = np.maximum(wide, np.float32(1e-6))
        shifted = place + np.float32(math.fmod(float(target[axis]), spacing)) + np.float32(spacing / 2)
        off = np.abs(shifted - np.floor(shifted / np.float32(spacing)) * np.float32(spacing) - np.float32(spacing / 2))
        part = (np.minimum(off + wide / 2, half) - np.maximum(off - wide / 2, -half)) / wide
        cover = np.maximum(cover, np.where(wide < spacing, part.clip(0, 1), np.float32(_LINE_SHARE)))
    return cover


def _shadow(scene: LitScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the share of light on the floor around the mesh as a grid [X, Z], its lower corner and its cell size, metres."""
    low, high = scene.solid.mesh.bounds
    tall = max(float(high[1]) - scene.floor_y, 0.05)
    thrown = -scene.key[[0, 2]] / scene.key[1] * tall
    corners = np.stack([low[[0, 2]], high[[0, 2]], low[[0, 2]] + thrown, high[[0, 2]] + thrown]).astype(np.float64)
    margin = 0.45 * tall
    lower, upper = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    cell = (upper - lower) / _CELLS
    index = np.stack(np.meshgrid(np.arange(_CELLS), np.arange(_CELLS), indexing="ij"), axis=-1).reshape(-1, 2)
    spots = lower + (index + 0.5) * cell
    points = np.stack([spots[:, 0], np.full(len(spots), scene.floor_y), spots[:, 1]], axis=1)
    normals = np.broadcast_to((0.0, 1.0, 0.0), points.shape)
    phase = (index[:, 0] % PATTERN) * PATTERN + index[:, 1] % PATTERN
    dome, key = scene.gather(points, normals, phase, floor=False)
    grid = np.stack([dome.mean(axis=1), key]).reshape(2, _CELLS, _CELLS)
    grid = np.stack([gaussian_filter(uniform_filter(g, PATTERN, mode="nearest"), 0.9) for g in grid])
    dome = np.minimum(grid[0] / np.percentile(grid[0], 90), 1)  # the brightest tenth counts as unshaded
    light = 0.58 * dome**1.6 + 0.42 * grid[1]
    # The border of the grid must be unshaded, or its edge would be visible on the floor.
    edge = np.minimum(np.arange(_CELLS), np.arange(_CELLS)[::-1]) / (0.2 * _CELLS)
    inner = np.minimum(np.minimum.outer(edge, edge), 1)
    return (1 - (1 - light) * inner * inner * (3 - 2 * inner)).astype(np.float32), lower, cell
