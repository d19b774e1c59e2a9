"""Points of the canonical surface, followed along their normals as the pose changes the shape, on the avatar's device."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from torch import Tensor
from torch.nn import functional as F

from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.lattice import flat_indices
from snarfcli.meshing.mesh import Mesh
from snarfcli.models.trained_field import TrainedField

__all__ = ["Followed"]

_STEPS = 8  # maximum number of steps along a normal
_FEWEST = 0.005  # share of the points at which the search stops: the last ones are in creases and get little trust
_REACHED_M = 1e-4  # a shorter step ends the search of a point; the mean is two evaluations per point
_LOST_M = 1e-3  # a point whose last step was longer has no level set along its normal
_SLOPE_M = 0.002  # half the distance over which the slope along a normal is measured
_LEAST_SLOPE = 3.0  # logits per metre; a flatter field has no surface to follow
_LONGEST_STEP_M = 0.01
_FARTHEST_M = 0.03  # maximum distance that the pose moves a point of the canonical surface along its normal
# Distance from the mean of its neighbours at which a point gets less trust. The shape moves smoothly, but in creases a normal
# meets the surface of the other side, or none, in one frame and not in the next. With this, none of 1.7 million motions of a
# vertex between two frames of jumping jacks is longer than 5 mm; without, 430 are (benchmarks/bm_surfaces.py).
_OUTLIER_M = 0.003
_FILLINGS = 20  # rounds in which points without a level set take the mean of their neighbours
_ROUNDS = 5  # rounds of smoothing
_PULL = 0.1  # weight of the neighbours for a point that agrees with them
_MOST_LOST = 0.5  # with a larger share of lost points the pose has no surface


class Followed:
    """Points of the canonical surface, followed along their normals as the pose changes the shape.

    Args:
        avatar: gives the shape.
        pose: [J, 3], the pose in which the points are on the level set.
        mesh: the points, with normals, and their neighbours.
    """

    def __init__(self, avatar: TrainedField, pose: Tensor, mesh: Mesh) -> None:
        self.avatar, pose = avatar, pose.to(avatar.device)
        self.points = torch.tensor(mesh.vertices, device=avatar.device)
        self.normals = torch.tensor(mesh.unit_normals, device=avatar.device)
        neighbours, degrees = _neighbours(mesh)
        self._neighbours, self._degrees = neighbours.to(avatar.device), degrees.to(avatar.device)
        every = torch.arange(len(self.points), device=avatar.device)
        ahead, behind = (self.logits(pose, every, self.points.new_full(every.shape, way)) for way in (_SLOPE_M, -_SLOPE_M))
        self.slope = ((ahead - behind) / (2 * _SLOPE_M)).clamp_max(-_LEAST_SLOPE)  # logits fall towards the outside

    def logits(self, pose: Tensor, index: Tensor, way: Tensor) -> Tensor:
        """Return the logits [K] in a pose at the points with indices [K], moved along their normals by `way` [K], metres."""
        return self.avatar.canonical_logits(self.points[index] + way[:, None] * self.normals[index], pose).float()

    def ways(self, pose: Tensor) -> Tensor:
        """Return the distance of the level set from each point, [C], metres along its normal.

        Raises:
            EmptySurface: most points have no level set near them.
        """
        way, last_step = self.nearest_ways(pose)
        lost = float((last_step.abs() > _LOST_M).float().mean())
        if lost > _MOST_LOST:
            share = f"{100 * lost:.0f} % of the mesh"
            raise EmptySurface(f"the shape of this pose has no surface within {100 * _FARTHEST_M:g} cm of {share}")
        # Points without a level set, or with one unlike all around them, follow their neighbours. Trust fades gradually: a
        # point with full trust in one frame and none in the next would jump.
        found = 1 / (1 + (last_step / _LOST_M) ** 2)
        smooth = way * found
        for _ in range(_FILLINGS):
            smooth = found * way + (1 - found) * self.around(smooth)
        for _ in range(_ROUNDS):
            around = self.around(smooth)
            trust = found / (1 + ((way - around) / _OUTLIER_M) ** 4)
            smooth = (trust * way + _PULL * around) / (trust + _PULL)
        return smooth

    @torch.no_grad()
    def settled(self, pose: Tensor) -> Tensor:
        """Return the points [C, 3] on the level set in a pose; those without one near them stay where they are."""
        way, last_step = self.nearest_ways(pose)
        return self.points + torch.where(last_step.abs() > _LOST_M, 0.0, way)[:, None] * self.normals

    def around(self, values: Tensor) -> Tensor:
        """Return the mean of values [C] over the neighbours of each point, [C]."""
        return F.pad(values, (0, 1))[self._neighbours].sum(1) / self._degrees

    def nearest_ways(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return where the search of each point ended and the length of its last step, both [C], metres along its normal.

        The search is Newton's method with the slope at rest, then secants; neighbours have no influence.
        """
        pose = pose.to(self.points.device)
        way = torch.zeros_like(self.slope)
        last_step = torch.zeros_like(way)
        left = torch.arange(len(way), device=way.device)  # points whose search has not ended
        slope, before, last = self.slope, way, None
        for _ in range(_STEPS):
            value = self.logits(pose, left, way[left])
            if last is not None:
                # The slope of the last step, within a factor of the one at rest.
                moved = way[left] - before
                secant = torch.where(moved != 0, (value - last) / moved, slope)
                slope = secant.clamp(3 * self.slope[left], self.slope[left] / 3)
            before = way[left]
            step = (-value / slope).clamp(-_LONGEST_STEP_M, _LONGEST_STEP_M)
            way[left] = (before + step).clamp(-_FARTHEST_M, _FARTHEST_M)
            last_step[left] = step
            going = flat_indices(step.abs() > _REACHED_M)
            left = left[going]
            before, last, slope = before[going], value[going], slope[going]
            if len(left) <= _FEWEST * len(way):
                break
        return way, last_step


def _neighbours(mesh: Mesh) -> tuple[Tensor, Tensor]:
    """Return the neighbours of each vertex, [V, K] int64, V for none, and their number, at least 1, [V] float32."""
    start, end = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    count = len(mesh.vertices)
    ends = (np.concatenate([start, end]), np.concatenate([end, start]))
    joined = coo_matrix((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(count, count)).tocsr()  # without repetitions
    degrees = np.diff(joined.indptr)
    table = np.full((count, degrees.max(initial=1)), count, dtype=np.int64)
    table[np.arange(table.shape[1]) < degrees[:, None]] = joined.indices
    return torch.from_numpy(table), torch.from_numpy(np.maximum(degrees, 1).astype(np.float32))
