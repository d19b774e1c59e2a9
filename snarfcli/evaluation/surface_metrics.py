"""Distance between two surfaces: Chamfer distance, normal consistency, F-score.

Points are spread evenly over both surfaces. Each is compared with the nearest point of the other surface, not with the nearest
of its samples, so two equal surfaces have distance zero for any number of points.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import igl
import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.evaluation.evaluate import choose_frames
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.surfaces import field_surface
from snarfcli.models.trained_field import TrainedField
from snarfcli.progress import progress
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.sampling.triangles import area_normals, random_points_in
from snarfcli.texts import counted

__all__ = ["F_SCORE_DISTANCE_M", "SurfaceMetrics", "compare_surfaces", "measure_surfaces", "sample_surface", "surfaces_text"]

log = logging.getLogger(__name__)

F_SCORE_DISTANCE_M = 0.005
"""Distance within which a point counts as correct in the F-score, metres."""


@dataclass(frozen=True)
class SurfaceMetrics:
    """Differences of two surfaces, from points on both."""

    chamfer_m: float
    """Mean of the two mean distances, from the prediction to the truth and back, metres (not squared)."""
    normal_consistency: float
    """Mean of the two mean cosines between the normals at a point and at the nearest point; 1: equal, -1: inside out."""
    f_score: float
    """Harmonic mean of two shares: the points of each surface within 5 mm of the other."""


def measure_surfaces(avatar: TrainedField, sequences: Sequence[SequenceSamples], count: int, resolution: int) -> dict[str, Any]:
    """Compare the avatar's surface with the true one in some frames, and return the results for `metrics.json`.

    Args:
        avatar: the avatar.
        sequences: samples.
        count: number of frames, evenly spaced over all sequences.
        resolution: voxels along the longest side of the extracted meshes.

    Returns:
        Means over the frames that have a surface, None if there is none; the number of frames, and of frames without a surface.
    """
    measured = []
    frames = choose_frames(sequences, count)
    for sequence, index in progress(frames, desc="comparing surfaces", unit="frames"):
        pose, translation, transforms = (
            torch.as_tensor(values[index]) for values in (sequence.poses, sequence.translation, sequence.bone_transforms)
        )
        try:
            predicted = field_surface(avatar, pose, translation, resolution, transforms=transforms)
        except (EmptySurface, FullSurface) as error:
            log.warning("warning: %s, frame %d: %s", sequence.name, sequence.frame_numbers[index], error)
            continue
        truth = sequence.vertices(index), sequence.faces(index)
        measured.append(compare_surfaces(truth, (predicted.vertices, predicted.faces)))
    names = ("chamfer_m", "normal_consistency", "f_score")
    means = {name: float(np.mean([getattr(one, name) for one in measured])) if measured else None for name in names}
    return {**means, "frames": len(frames), "frames_without_surface": len(frames) - len(measured), "resolution": resolution}


def surfaces_text(surfaces: Mapping[str, Any]) -> str:
    """Return the results of `measure_surfaces` as one line."""
    frames = surfaces["frames"] - surfaces["frames_without_surface"]
    if not frames:
        return f"surfaces: none in {counted(surfaces['frames'], 'frame')}"
    return (
        f"surfaces of {counted(frames, 'frame')} at resolution {surfaces['resolution']}: Chamfer distance "
        f"{1000 * surfaces['chamfer_m']:.2f} mm, normal consistency {surfaces['normal_consistency']:.4f}, "
        f"F-score at {1000 * F_SCORE_DISTANCE_M:g} mm {100 * surfaces['f_score']:.2f} %"
    )


def sample_surface(
    vertices: NDArray, faces: NDArray, count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points [N, 3] spread evenly over a surface, and the index of the face of each [N].

    Args:
        vertices: [V, 3] metres.
        faces: [F, 3] vertex numbers.
        count: N.
        generator: source of random numbers.

    Raises:
        ValueError: the surface has no area.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    areas = np.linalg.norm(area_normals(corners), axis=1)  # twice the areas
    if not areas.sum() > 0:
        raise ValueError("the surface has no area, so nothing can be compared with it")
    # Evenly spaced in the running area: as random as independent draws, with less noise.
    places = (np.arange(count) + generator.random(count)) / count
    chosen = np.minimum(np.searchsorted(np.cumsum(areas) / areas.sum(), places), len(faces) - 1)
    return random_points_in(corners[chosen], generator), chosen


def compare_surfaces(
    truth: tuple[NDArray, NDArray],
    predicted: tuple[NDArray, NDArray],
    *,
    count: int = 20_000,
    seed: int = 0,
) -> SurfaceMetrics:
    """Compare two surfaces.

    Args:
        truth: vertices [V, 3], metres, and outward faces [F, 3].
        predicted: vertices and faces of the prediction, as for `truth`.
        count: number of points on each surface.
        seed: of the points.

    Raises:
        ValueError: a surface has no area.
    """
    generator = np.random.default_rng(seed)
    forth = _distances(predicted, truth, count, generator)
    back = _distances(truth, predicted, count, generator)
    distance, cosine, share = zip(forth, back, strict=True)
    return SurfaceMetrics(
        chamfer_m=float(np.mean(distance)),
        normal_consistency=float(np.mean(cosine)),
        f_score=float(2 * share[0] * share[1] / max(share[0] + share[1], 1e-12)),
    )


def _distances(
    start: tuple[NDArray, NDArray], end: tuple[NDArray, NDArray], count: int, generator: np.random.Generator
) -> tuple[float, float, float]:
    """Return mean distance, mean cosine of the normals and share within 5 mm, from one surface to the other."""
    points, faces = sample_surface(*start, count, generator)
    vertices, triangles = np.asarray(end[0], np.float64), np.asarray(end[1], np.int64)
    squared, nearest, _ = igl.point_mesh_squared_distance(points, vertices, triangles)[:3]
    distance = np.sqrt(np.asarray(squared).reshape(-1))
    cosine = (_normals(*start)[faces] * _normals(*end)[np.asarray(nearest).reshape(-1)]).sum(1)
    return float(distance.mean()), float(cosine.mean()), float((distance <= F_SCORE_DISTANCE_M).mean())


def _normals(vertices: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Return the unit normals [F, 3] of faces; zero for one without area."""
    normal = area_normals(np.asarray(vertices, np.float64)[faces])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
