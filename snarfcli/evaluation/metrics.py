"""Intersection over union of occupancy samples, per frame, and its means.

Protocol (SNARF Sec. 4.1 and its released code): half of a frame's points are uniform in a cube around the posed mesh, whose
side is the longest side of the tight box times 1.1 (IoU bbox); the other half are near the surface (IoU surface). The IoU is
computed per frame. The papers' tables state the mean over all frames, so a long sequence counts for more than a short one.
The IoU of the tight box uses the uniform points in the tight box of the posed mesh. Points that both call outside never
count, so it differs from IoU bbox only by what the avatar adds outside that box, such as floating blobs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["FrameMetrics", "Summary", "group_by_sequence", "in_box", "iou", "mean_of_sequences", "summarise"]

_COUNTS = ("points", "correspondences", "several", "without", "inside", "inside_without")
_SUMMED = (*_COUNTS, "search_s", "shape_s", "total_s")  # over frames


@dataclass(frozen=True)
class FrameMetrics:
    """Results of one frame."""

    sequence: str
    """Name of the sequence."""
    index: int
    """Index of the frame in the samples."""
    frame: int
    """Number of the frame in the motion, of which the samples may omit some."""
    iou_bbox: float
    """IoU of the uniform points in the papers' cube, 0 to 1."""
    iou_surface: float
    """IoU of the points near the surface, 0 to 1."""
    iou_tight_box: float
    """IoU of the uniform points in the tight box of the posed mesh, 0 to 1."""
    points: int
    """Number of points."""
    correspondences: int
    """Number of correspondences of all points."""
    several: int
    """Number of points with more than one correspondence: where the body touches or crosses itself."""
    without: int
    """Number of points without a correspondence."""
    inside: int
    """Number of points that are inside."""
    inside_without: int
    """Number of points that are inside and have no correspondence, so that they cannot be predicted correctly."""
    search_s: float
    """Seconds for the correspondence search."""
    shape_s: float
    """Seconds for the shape network."""
    total_s: float
    """Seconds for the whole query."""


@dataclass(frozen=True)
class Summary:
    """Means over frames; shares and times over the points of all frames."""

    frames: int
    """Number of frames."""
    points: int
    """Number of points of all frames."""
    iou_bbox: float
    """Mean over frames, 0 to 1."""
    iou_surface: float
    """Mean over frames, 0 to 1."""
    iou_tight_box: float
    """Mean over frames, 0 to 1."""
    worst_iou_surface: float
    """Lowest of all frames, 0 to 1."""
    correspondences_per_point: float
    """Mean number of correspondences of a point that has any."""
    several: float
    """Share of points with more than one correspondence, 0 to 1."""
    without: float
    """Share of points without a correspondence, 0 to 1."""
    inside_without: float
    """Share of the inside points without a correspondence, 0 to 1; 0 if no point is inside."""
    search_s: float
    """Seconds for the correspondence search, all frames."""
    shape_s: float
    """Seconds for the shape network, all frames."""
    total_s: float
    """Seconds for the whole queries, all frames."""


def iou(predicted: np.ndarray, occupied: np.ndarray, where: np.ndarray | None = None) -> np.ndarray:
    """Return the intersection over union of two sets of points, 1 where both are empty.

    Two empty sets agree; a frame without inside points must not break a mean.

    Args:
        predicted: [..., N] bool, points that are predicted to be inside.
        occupied: [..., N] bool, points that are inside.
        where: [..., N] bool, points that count; None for all.

    Returns:
        [...] float64, 0 to 1.

    Raises:
        ValueError: the shapes differ.
        TypeError: an array is not of bools.
    """
    arrays = {"predicted": np.asarray(predicted), "occupied": np.asarray(occupied)}
    if where is not None:
        arrays["where"] = np.asarray(where)
    for name, array in arrays.items():
        if array.dtype != np.bool_:
            raise TypeError(f"{name}: wanted an array of bools, got {array.dtype}")
        if array.ndim == 0 or array.shape != arrays["predicted"].shape:
            raise ValueError(f"{name}: wanted shape {list(arrays['predicted'].shape)}, [..., N], got {list(array.shape)}")
    both, either = arrays["predicted"] & arrays["occupied"], arrays["predicted"] | arrays["occupied"]
    if where is not None:
        both, either = both & arrays["where"], either & arrays["where"]
    union = either.sum(axis=-1)
    return np.where(union == 0, 1.0, both.sum(axis=-1) / np.maximum(union, 1))


def in_box(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return which points [N, 3] lie in the box with corners lower [3] and upper [3], borders included, bool [N]."""
    return np.all((points >= lower) & (points <= upper), axis=-1)


def summarise(frames: Sequence[FrameMetrics]) -> Summary:
    """Return the means of the results of frames.

    Raises:
        ValueError: there is no frame.
    """
    if not frames:
        raise ValueError("frames: wanted at least one frame, got none")
    total = {name: sum(getattr(frame, name) for frame in frames) for name in _SUMMED}
    return Summary(
        frames=len(frames),
        points=total["points"],
        iou_bbox=float(np.mean([frame.iou_bbox for frame in frames])),
        iou_surface=float(np.mean([frame.iou_surface for frame in frames])),
        iou_tight_box=float(np.mean([frame.iou_tight_box for frame in frames])),
        worst_iou_surface=min(frame.iou_surface for frame in frames),
        correspondences_per_point=total["correspondences"] / max(total["points"] - total["without"], 1),
        several=total["several"] / max(total["points"], 1),
        without=total["without"] / max(total["points"], 1),
        inside_without=total["inside_without"] / max(total["inside"], 1),
        search_s=total["search_s"],
        shape_s=total["shape_s"],
        total_s=total["total_s"],
    )


def group_by_sequence(frames: Sequence[FrameMetrics]) -> dict[str, list[FrameMetrics]]:
    """Return the frames of each sequence, in the order of their first frames."""
    groups: dict[str, list[FrameMetrics]] = {}
    for frame in frames:
        groups.setdefault(frame.sequence, []).append(frame)
    return groups


def mean_of_sequences(frames: Sequence[FrameMetrics]) -> dict[str, float]:
    """Return the mean of each IoU over sequences, each counted once regardless of its length."""
    summaries = [summarise(group) for group in group_by_sequence(frames).values()]
    names = ("iou_bbox", "iou_surface", "iou_tight_box")
    return {name: float(np.mean([getattr(summary, name) for summary in summaries])) for name in names}
