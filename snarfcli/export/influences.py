"""Few joints a vertex: which of them, and with what weights, so that the surface moves as with all."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.skinning import blend_transforms

__all__ = ["dense_weights", "few_influences", "trial_poses"]

_SPARE = 4  # joints that are looked at beyond those that are kept
_NEGLIGIBLE = 1e-4  # of a vertex's weight: a tenth of a millimetre where joints move a metre apart
_PULL_M2 = 1e-6  # towards the learned weights, against a square metre; decides where poses do not
_TRIALS = 64
_TRIAL_RAD = 0.35  # standard deviation of each joint's turns about each axis
# What all trials together count against all poses of the clips. On a body, jumping jacks are off by 1.4 mm at most, and martial
# arts that the weights were not made for by 4.5 mm; without trials by 1.0 and 6.4, with trials ten times as heavy by 2.6 and
# 4.1, and with the largest weights as they are by 15.1 and 18.1.
_TRIAL_SHARE = 0.01
_PART = 2000  # vertices at a time: with 128 poses they take 60 MB at most, however many joints there are


def trial_poses(skeleton: Skeleton, transforms: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Add random poses to those of clips: what is fitted to standing still alone would fit no other motion.

    Args:
        skeleton: the joints, which are turned about the canonical pose.
        transforms: [S, J, 4, 4] bone transforms of the clips, canonical to posed.

    Returns:
        Transforms [S + 64, J, 4, 4], and what each of them counts, [S + 64].
    """
    skeleton = skeleton.to(dtype=torch.float64, device="cpu")
    turns = np.random.default_rng(0).normal(scale=_TRIAL_RAD, size=(_TRIALS, skeleton.num_joints, 3))
    trials = skeleton.posed_from_canonical(skeleton.canonical_pose + torch.from_numpy(turns)).numpy()
    counts = np.r_[np.full(len(transforms), 1 / len(transforms)), np.full(_TRIALS, _TRIAL_SHARE / _TRIALS)]
    return np.concatenate([transforms, trials]), counts


def few_influences(
    weights: NDArray[np.float32],
    count: int,
    vertices: NDArray[np.float32],
    transforms: NDArray[np.float64],
    counts: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Keep `count` joints a vertex, those and with such weights that it moves as with all of them.

    The largest weights alone would keep three bones of the spine, which move as one, and drop the shoulder, which moves far.

    Args:
        weights: [V, J] non-negative, rows sum to 1.
        count: how many to keep; columns of zeros are added where there are fewer joints.
        vertices: [V, 3] canonical, metres.
        transforms: [S, J, 4, 4] canonical to posed: poses in which they should move alike.
        counts: [S] what each pose counts.

    Returns:
        Joints [V, count], largest weight first, 0 where the weight is zero, and weights [V, count], whose rows sum to 1.
    """
    kept = min(count, weights.shape[1])
    joints = np.argsort(-weights, axis=1, kind="stable")[:, : count + _SPARE]
    values = np.take_along_axis(weights.astype(np.float64), joints, axis=1).clip(0)
    crowded = np.flatnonzero(1 - values[:, :kept].sum(axis=1) > _NEGLIGIBLE)
    best = values[:, :kept] / values[:, :kept].sum(axis=1, keepdims=True)
    chosen = joints[:, :kept].copy()
    for start in range(0, len(crowded), _PART):
        rows = crowded[start : start + _PART]
        fitted = _fitted(weights[rows], values[rows], joints[rows], kept, vertices[rows], transforms, counts)
        order = np.argsort(-fitted, axis=1, kind="stable")[:, :kept]
        best[rows] = np.take_along_axis(fitted, order, axis=1)
        chosen[rows] = np.take_along_axis(joints[rows], order, axis=1)
    best = best.astype(np.float32)
    chosen = np.where(best > 0, chosen, 0)
    return tuple(np.pad(array, ((0, 0), (0, count - kept))) for array in (chosen, best))


def dense_weights(joints: NDArray[np.int64], values: NDArray[np.float32], num_joints: int) -> NDArray[np.float64]:
    """Return the weights [V, K] of joints [V, K] as weights of all joints [V, J]."""
    dense = np.zeros((len(joints), num_joints))
    for joint, value in zip(joints.T, values.T, strict=True):
        dense[np.arange(len(joints)), joint] += value
    return dense


def _fitted(
    weights: NDArray[np.float32],
    values: NDArray[np.float64],
    joints: NDArray[np.int64],
    kept: int,
    vertices: NDArray[np.float32],
    transforms: NDArray[np.float64],
    counts: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the weights [N, C] of candidates [N, C], all but `kept` of which are zero: they go one by one, least missed first.

    With weights v that sum to 1 a vertex is off by sum_c v_c (B_c x - y), where y is its place with all weights: a quadratic
    form of v, whose matrix G sums over the poses.
    """
    points = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1, dtype=np.float64)
    apart = np.empty((*joints.shape, len(transforms), 3))
    weights = weights.astype(np.float64)
    for pose, (matrices, share) in enumerate(zip(transforms[:, :, :3], np.sqrt(counts), strict=True)):
        blended = blend_transforms(weights, matrices)[:, None]
        apart[:, :, pose] = share * np.einsum("ncab,nb->nca", matrices[joints] - blended, points)
    apart = apart.reshape(*joints.shape, -1)
    products = apart @ apart.transpose(0, 2, 1)
    prior = values / values.sum(axis=1, keepdims=True)
    alive = np.ones(values.shape, dtype=bool)
    best = prior
    rows = np.arange(len(values))
    for _ in range(values.shape[1] - kept):
        tries = []
        for column in range(values.shape[1]):
            without = alive.copy()
            without[:, column] = False
            found = _least(products, prior, without)
            error = np.einsum("nc,ncd,nd->n", found, products, found) + _PULL_M2 * ((found - prior) ** 2).sum(axis=1)
            tries.append((np.where(alive[:, column], error, np.inf), found))
        dropped = np.argmin([error for error, _ in tries], axis=0)
        alive[rows, dropped] = False
        best = np.stack([found for _, found in tries], axis=1)[rows, dropped]
    return best


def _least(products: NDArray[np.float64], prior: NDArray[np.float64], alive: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return weights [N, C], zero where not alive, that sum to 1 and make v G v + pull |v - prior|^2 least.

    What comes out negative is cut off, and the rest scaled.
    """
    size = products.shape[1]
    both = alive[:, :, None] & alive[:, None, :]
    system = np.zeros((len(products), size + 1, size + 1))
    system[:, :size, :size] = np.where(both, products, 0) + np.eye(size) * np.where(alive, _PULL_M2, 1.0)[:, :, None]
    system[:, :size, size] = system[:, size, :size] = alive
    right = np.concatenate([np.where(alive, _PULL_M2 * prior, 0), np.ones((len(products), 1))], axis=1)
    found = np.linalg.solve(system, right[:, :, None])[:, :size, 0].clip(0)
    return found / found.sum(axis=1, keepdims=True)
