"""The pose-dependent shape as few morph targets: principal components of the motion of the canonical surface.

Linear blend skinning moves each vertex nearly rigidly, so errors of the canonical and of the posed shape are equal: the
components are found in the canonical frame, with equal weights of all vertices and frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["ShapeBasis", "fit_shapes", "spread_frames"]

_INVISIBLE_M = 1e-5
"""Components that move every vertex by less than this in all frames are left out, metres."""
_ROUNDING = 1e-9  # share of the largest variance: vertices are float32, in metres, and the shape moves by centimetres


@dataclass(frozen=True, eq=False)
class ShapeBasis:
    """A base shape and morph targets."""

    base: NDArray[np.float32]
    """[V, 3] shape with weights 0, metres."""
    targets: NDArray[np.float32]
    """[K, V, 3] displacements by weight 1, metres; orthogonal, the largest first."""
    rest: NDArray[np.float32]
    """[K] weights of the mean shape."""

    def weights(self, shape: NDArray) -> NDArray[np.float32]:
        """Return the weights [K] that fit a shape [V, 3] best (least squares)."""
        moved = (shape - self.base).reshape(-1)
        flat = self.targets.reshape(len(self.targets), moved.size)
        return (flat @ moved) / np.einsum("kv,kv->k", flat, flat)

    def shape(self, weights: NDArray) -> NDArray[np.float32]:
        """Return the shape [V, 3] of weights [K]."""
        return self.base + np.tensordot(weights.astype(np.float32), self.targets, 1)

    def within_unit_range(self, weights: Sequence[NDArray[np.float32]]) -> tuple[ShapeBasis, list[NDArray[np.float32]]]:
        """Return an equivalent basis for which all weights [T, K] are from 0 to 1, and these weights.

        Programs show sliders from 0 to 1, and some clip weights to this range: Blender's importer extends it for the first key
        only. Each component starts at the end of its range that is nearer to the mean; `rest` has the weights of the mean.
        """
        if not len(self.targets):
            return self, list(weights)
        lowest = np.min([clip.min(axis=0) for clip in weights], axis=0)
        highest = np.max([clip.max(axis=0) for clip in weights], axis=0)
        starts_low = np.abs(lowest) <= np.abs(highest)
        start = np.where(starts_low, lowest, highest)
        span = np.where(starts_low, highest, lowest) - start
        span = np.where(span == 0, 1, span).astype(np.float32)
        changed = ShapeBasis(self.shape(start), self.targets * span[:, None, None], (self.rest - start) / span)
        return changed, [((clip - start) / span).clip(0, 1) for clip in weights]

    def two_sided(self, weights: Sequence[NDArray[np.float32]]) -> tuple[ShapeBasis, list[NDArray[np.float32]]]:
        """Return an equivalent basis with one target per component and direction, and its weights, from 0 to 1.

        With all weights at 0, as programs show it without a motion, it has the mean shape. Directions that no clip
        uses are left out.
        """
        if not len(self.targets):
            return self, list(weights)
        everything = np.concatenate(weights) - self.rest
        spans = np.concatenate([everything.max(axis=0), -everything.min(axis=0)]).clip(0)
        used = spans > _ROUNDING * spans.max()
        both = np.concatenate([self.targets, -self.targets])[used] * spans[used, None, None]
        sides = [np.concatenate([clip - self.rest, self.rest - clip], axis=1)[:, used] / spans[used] for clip in weights]
        changed = ShapeBasis(self.shape(self.rest), both.astype(np.float32), np.zeros(len(both), np.float32))
        return changed, [clip.clip(0, 1).astype(np.float32) for clip in sides]


def spread_frames(lengths: Sequence[int], most: int) -> list[tuple[int, int]]:
    """Return at most `most` pairs (clip, frame), evenly spread over all clips together."""
    ends = np.cumsum(lengths)
    total = int(ends[-1])
    count = min(most, total)
    picked = (2 * np.arange(count) + 1) * total // (2 * count)
    clips = np.searchsorted(ends, picked, "right")
    return [(int(clip), int(frame - ends[clip] + lengths[clip])) for clip, frame in zip(clips, picked, strict=True)]


def fit_shapes(shapes: NDArray[np.float32], count: int) -> ShapeBasis:
    """Return the mean of shapes [S, V, 3] and at most `count` principal components of the differences from it.

    The base is the mean, which is nearest to all shapes, and not the shape of the canonical pose, which no clip may contain.
    """
    base = shapes.mean(axis=0, dtype=np.float64).astype(np.float32)
    moved = (shapes - base).reshape(len(shapes), -1)
    if not count or len(shapes) < 2:
        return ShapeBasis(base, np.zeros((0, *base.shape), np.float32), np.zeros(0, np.float32))
    # S is much smaller than 3 V: the components are found from the S x S products, in float64 for the small ones.
    products = np.zeros((len(shapes), len(shapes)))
    for start in range(0, moved.shape[1], 2**16):
        part = moved[:, start : start + 2**16].astype(np.float64)
        products += part @ part.T
    values, vectors = np.linalg.eigh(products)
    order = np.argsort(-values)[:count]
    order = order[values[order] > _ROUNDING * max(values.max(), 1e-30)]
    targets = vectors[:, order].T.astype(np.float32) @ moved
    targets /= np.linalg.norm(targets, axis=1, keepdims=True).clip(1e-30)
    played = np.abs(moved @ targets.T).max(axis=0)  # largest weights
    targets = targets.reshape(len(order), *base.shape)
    largest = played * np.linalg.norm(targets, axis=2).max(axis=1)
    targets = targets[largest > _INVISIBLE_M]
    return ShapeBasis(base, targets, np.zeros(len(targets), np.float32))
