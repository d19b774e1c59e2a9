"""Gauss-Newton steps that bring the posed surface of an avatar onto surfaces that are seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.bodies import Skeleton
from snarfcli.deformer import skin
from snarfcli.fitting.corrections import Corrections, Corrector, bone_turns
from snarfcli.models.fast_snarf import FastSnarf

__all__ = ["CanonicalPoints", "FittedPoses", "PoseFit", "Surfaces"]

_FARTHEST_M = 0.05  # a longer distance to the surface, estimated from logit and slope, counts as this one
_LEAST_SLOPE = 5.0  # logits per metre; a flatter field says nothing about the distance
_LEAST_AGREEMENT = 0.3  # cosine between the normals of a point and of the avatar there; about 70 degrees
_NORMALS_M = 0.08  # distance that counts as much as normals at 60 degrees to each other, in the search of closest points
_SCALE_OF_OUTLIERS = 3.0  # in medians of the distances of a frame: a quarter of the weight
# The prior: how far the place usually is from the given one, and how much the points of a frame tell, as if this number of them
# were independent and accurate to a few millimetres.
_SHIFT_M = 0.03
_ACCURACY_M = 0.004
_INDEPENDENT_POINTS = 100
_LONGEST_TURN_RAD = 0.2  # in one step
_LONGEST_SHIFT_M = 0.05


@dataclass(frozen=True)
class Surfaces:
    """Points on the surfaces of B posed bodies."""

    points: Tensor
    """[B, N, 3], posed frame, metres."""
    normals: Tensor
    """[B, N, 3], unit length, outward."""

    def take(self, index: Tensor) -> Surfaces:
        """Return the points with indices [B, K]."""
        return Surfaces(_take(self.points, index), _take(self.normals, index))


@dataclass(frozen=True)
class CanonicalPoints:
    """Points on the canonical surface of an avatar."""

    points: Tensor
    """[S, 3], metres."""
    normals: Tensor
    """[S, 3], unit length, outward."""
    weights: Tensor
    """[S, J], skinning weights."""


@dataclass(frozen=True)
class FittedPoses:
    """Result of a step."""

    corrections: Corrections
    """Of the B poses, including those that the step began with."""
    distance: Tensor
    """[B], mean distance of matched points before the step, metres; infinite if there was no match."""
    matched: Tensor
    """[B], share of the points that had a match."""


@dataclass(frozen=True)
class _Trust:
    """How far a kind of matches is trusted."""

    turn_rad: float
    """How far joints usually are from the given angles, radians: the prior against turns that the matches hardly determine."""
    scale_m: float
    """Distance that is no outlier yet, however good the other matches are, metres."""


# Closest points slide: they say little about the turn of a round limb about its axis. And a hand or foot that is two
# centimetres away must not count as an outlier. In the field, larger distances come from the wrong correspondences.
_APPROACHING = _Trust(0.06, 0.02)
_SETTLING = _Trust(0.2, 0.005)


@dataclass(frozen=True)
class _Matches:
    """M pairs of a point of the avatar and a point that is seen, for each of B poses."""

    distance: Tensor
    """[B, M], how far the avatar is outside of what is seen, along the normal, metres."""
    rows: Tensor
    """[B, M, 3 J + 3], derivative of the distance by the turns of the joints, in the axes of the posed frame, and by the shift;
    metres per radian, and metres per metre."""
    used: Tensor
    """[B, M], bool; elsewhere distance and rows are zero."""


class PoseFit:
    """Fit corrections of poses to surfaces, with the avatar as it is.

    Every step matches points, and how the distance of each match changes with the turn of each joint and with the shift is
    known in closed form (linear blend skinning); so a step solves one small linear system per pose, with robust weights and a
    prior that keeps the corrections small. There are two kinds of matches: the closest points of both surfaces (`approach`),
    which also lead there from 10 cm away, and the exact distance in the avatar's field (`settle`), for the last millimetres.

    Args:
        model: a system with forward skinning.
        skeleton: of the avatar.
        precision: of the shape network.

    Source: Gauss-Newton with iteratively reweighted least squares (Geman-McClure weights) and point-to-plane distances (Chen
        and Medioni 1992), as is common in registration; the exact distances use the correspondences of SNARF Sec. 3.2.
    """

    def __init__(self, model: FastSnarf, skeleton: Skeleton, precision: str = "highest") -> None:
        self.model, self.precision = model, precision
        device = model.grid.lower.device
        self.corrector = Corrector(skeleton, device)
        self._moved_by = _descendants(skeleton.parents).to(device)

    @torch.no_grad()
    def approach(
        self, avatar: CanonicalPoints, seen: Surfaces, bone_transforms: Tensor, pose: Tensor, corrections: Corrections
    ) -> FittedPoses:
        """Take one step that brings closest points together; arguments as in `settle`.

        Args:
            avatar: points of the avatar's surface, in the shape of any pose.
        """
        current, _ = self.corrector.correct(bone_transforms, pose, corrections)
        points, normals = _posed(avatar, current)
        batch, own = points.shape[:2]
        back = min(own // 2, seen.points.shape[1])
        partner, chosen = _closest(points, normals, seen, back)
        chosen = torch.cat([torch.arange(own, device=chosen.device).expand(batch, own), chosen], 1)
        partner = torch.cat([partner, torch.arange(back, device=partner.device).expand(batch, back)], 1)
        other = seen.take(partner)
        used = (_take(normals, chosen) * other.normals).sum(-1) > _LEAST_AGREEMENT
        distance = ((_take(points, chosen) - other.points) * other.normals).sum(-1)
        rows = self._rows(avatar.points[chosen], avatar.weights[chosen], other.normals, current)
        return self._solve(_Matches(distance * used, rows * used[..., None], used), current, corrections, _APPROACHING)

    @torch.no_grad()
    def settle(
        self, avatar: CanonicalPoints, seen: Surfaces, bone_transforms: Tensor, pose: Tensor, corrections: Corrections
    ) -> FittedPoses:
        """Take one step that brings the level set of the avatar's field to the points that are seen.

        Args:
            avatar: points of the avatar's surface; only the points that are seen closest to these are used.
            seen: points of B bodies.
            bone_transforms: [B, J, 4, 4], uncorrected, canonical to posed, metres.
            pose: [B, J, 3], uncorrected, axis-angle, radians.
            corrections: to start from.
        """
        current, current_pose = self.corrector.correct(bone_transforms, pose, corrections)
        closest, _ = _closest(*_posed(avatar, current), seen)
        return self._solve(self._match_field(seen.take(closest), current, current_pose), current, corrections, _SETTLING)

    def _match_field(self, seen: Surfaces, bone_transforms: Tensor, pose: Tensor) -> _Matches:
        """Match each point that is seen with the avatar's level set beyond its canonical correspondence."""
        model = self.model
        batch, count = seen.points.shape[:2]
        found = model.find(seen.points, bone_transforms, pose)
        roots = found.roots
        weights = model.deformer.skinning_weights(roots.canonical, found.weights)
        canonical = roots.canonical.detach().requires_grad_()
        with torch.enable_grad():
            shares = weights if model.depends_on_weights else None
            logits = model.canonical_logits(canonical, model.condition(pose), roots.pose, self.precision, shares)
            (slope_c,) = torch.autograd.grad(logits.sum(), canonical)
        logits = logits.detach()
        slope = (roots.jacobian_inverse.transpose(1, 2) @ slope_c[..., None])[..., 0]
        steepness = slope.norm(dim=1)
        normal = -slope / steepness.clamp_min(1e-9)[:, None]
        agreement = (normal * seen.normals.flatten(0, 1)[roots.query]).sum(1)
        usable = (agreement > _LEAST_AGREEMENT) & (steepness > _LEAST_SLOPE)
        chosen = _best_root(logits, usable, roots.query, batch * count)
        distance = (logits[chosen] / steepness[chosen]).clamp(-_FARTHEST_M, _FARTHEST_M)
        query = roots.query[chosen]

        def spread(values: Tensor) -> Tensor:
            """Return values of the chosen roots [K, ...] at their points, [B, N, ...], with zeros elsewhere."""
            out = values.new_zeros(batch * count, *values.shape[1:]).index_copy(0, query, values)
            return out.unflatten(0, (batch, count))

        rows = self._rows(spread(roots.canonical[chosen]), spread(weights[chosen]), spread(normal[chosen]), bone_transforms)
        return _Matches(spread(distance), rows, spread(torch.ones_like(chosen, dtype=torch.bool)))

    def _rows(self, canonical: Tensor, weights: Tensor, normal: Tensor, bone_transforms: Tensor) -> Tensor:
        """Return how far posed points move along normals per turn of each joint and per shift, [B, M, 3 J + 3].

        A turn w about joint k moves a point by w x a, with a the lever of what follows the joint; along n this is w . (a x n).

        Args:
            canonical: [B, M, 3], the points, metres.
            weights: [B, M, J], their skinning weights.
            normal: [B, M, 3], posed frame, unit length; zero for points that are not used.
            bone_transforms: [B, J, 4, 4].
        """
        upper = bone_transforms[:, :, :3].permute(0, 3, 2, 1)  # [B, 4, 3, J]
        moved = torch.matmul(F.pad(canonical, (0, 1), value=1.0), upper.flatten(2)).unflatten(2, (3, -1))  # [B, M, 3, J]
        centre = self.corrector.joints(bone_transforms).transpose(1, 2)[:, None]  # [B, 1, 3, J]
        shares = (weights @ self._moved_by)[:, :, None]
        a, b, c = ((weights[:, :, None] * moved) @ self._moved_by - shares * centre).unbind(2)
        x, y, z = normal[..., None].unbind(2)
        along = torch.stack([b * z - c * y, c * x - a * z, a * y - b * x], -1)
        return torch.cat([along.flatten(2), normal], 2)

    def _solve(self, matches: _Matches, bone_transforms: Tensor, corrections: Corrections, trust: _Trust) -> FittedPoses:
        """Return the corrections that bring matched points together, as far as the prior allows."""
        distance, used = matches.distance, matches.used
        count = used.sum(1).clamp_min(1)
        size = distance.abs()
        middle = torch.where(used, size, torch.nan).nanmedian(1).values.nan_to_num(_FARTHEST_M)
        scale = (_SCALE_OF_OUTLIERS * middle).clamp_min(trust.scale_m)
        share = torch.where(used, 1 / (1 + (distance / scale[:, None]).square()).square(), 0.0) / count[:, None]
        weighted = matches.rows * share[..., None]
        axes = bone_turns(bone_transforms)  # from the axes of the bones, those of the corrections, to those of the rows
        before = torch.cat([(axes @ corrections.turn[..., None]).flatten(1), corrections.shift], 1)
        prior = torch.full_like(before[0], (_ACCURACY_M / trust.turn_rad) ** 2 / _INDEPENDENT_POINTS)
        prior[-3:] = (_ACCURACY_M / _SHIFT_M) ** 2 / _INDEPENDENT_POINTS
        gradient = (weighted * distance[..., None]).sum(1) + prior * before
        change = -torch.linalg.solve(weighted.transpose(1, 2) @ matches.rows + prior.diag(), gradient)
        turn = axes.transpose(-1, -2) @ change[:, :-3].unflatten(1, (-1, 3))[..., None]
        after = corrections.then(_limited(turn[..., 0], _LONGEST_TURN_RAD), _limited(change[:, -3:], _LONGEST_SHIFT_M))
        mean = torch.where(used, size, 0.0).sum(1) / count
        return FittedPoses(after, mean.where(used.any(1), torch.inf), used.float().mean(1))


def _posed(avatar: CanonicalPoints, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
    """Return the avatar's points and normals in B poses, both [B, S, 3]."""
    points, normals = skin(avatar.points, avatar.weights, bone_transforms, directions=avatar.normals)
    return points, F.normalize(normals, dim=-1)


def _closest(points: Tensor, normals: Tensor, seen: Surfaces, back: int = 0) -> tuple[Tensor, Tensor]:
    """Match points [B, S, 3] with normals to seen ones, by place and normal.

    Returns:
        The index of the seen point closest to each point, [B, S]; that of the point closest to each of the first `back` seen
        points, [B, back].
    """
    centre = seen.points.mean(1, keepdim=True)  # far from the origin distances would be inexact
    own = torch.cat([points - centre, _NORMALS_M * normals], -1)
    apart = torch.cdist(own, torch.cat([seen.points - centre, _NORMALS_M * seen.normals], -1))
    return apart.argmin(2), apart[..., :back].argmin(1) if back else apart.new_empty(len(apart), 0, dtype=torch.long)


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Return the rows of values [B, N, 3] with indices [B, K], [B, K, 3]."""
    return values.gather(1, index[..., None].expand(-1, -1, 3))


def _best_root(logits: Tensor, usable: Tensor, query: Tensor, queries: int) -> Tensor:
    """Return the indices [K] of the usable root with the largest logit of each query that has one."""
    value = logits.where(usable, -torch.inf)
    best = value.new_full((queries,), -torch.inf).scatter_reduce(0, query, value, "amax")
    return (usable & (value == best[query])).nonzero()[:, 0]


def _descendants(parents: Sequence[int]) -> Tensor:
    """Return a matrix [J, J] with 1 where bone j (row) is joint k (column) or follows it, and 0 elsewhere."""
    matrix = torch.eye(len(parents))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            matrix[joint] += matrix[parent]
    return matrix


def _limited(vectors: Tensor, longest: float) -> Tensor:
    """Return vectors [..., 3], shortened to a length of at most `longest`."""
    return vectors * (longest / vectors.norm(dim=-1, keepdim=True).clamp_min(longest))
