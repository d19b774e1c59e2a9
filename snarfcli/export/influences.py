"""Reduce the number of joints per vertex, with weights for which the surface moves as with all joints."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.skinning import blend_transforms

__all__ = ["dense_weights", "few_influences", "trial_poses"]

_SPARE = 4  # candidate joints beyond those that are kept
_NEGLIGIBLE = 1e-4  # share of the weights of a vertex: a tenth of a millimetre where joints move a metre apart
_PULL_M2 = 1e-6  # regularisation towards the learned weights, square metres; decides where the poses do not
_TRIALS = 64
_TRIAL_RAD = 0.35  # standard deviation of the rotation of each joint about each axis
# Weight of all trials together relative to all poses of the clips. Measured maximum errors on a body, for jumping jacks and for
# martial arts that the weights were not fitted to: 1.4 and 4.5 mm; without trials 1.0 and 6.4 mm; with ten times this weight
# 2.6 and 4.1 mm; with the largest weights unchanged 15.1 and 18.1 mm.
_TRIAL_SHARE = 0.01
_PART = 2000  # vertices at a time: with 128 poses they take at most 60 MB, for any number of joints


def trial_poses(skeleton: Skeleton, transforms: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Add random poses to those of clips, since weights fitted to a body that stands still would fit no other motion.

    Args:
        skeleton: skeleton, turned randomly about its canonical pose.
        transforms: [S, J, 4, 4] bone transforms of the clips, canonical to posed.

    Returns:
        Transforms [S + 64, J, 4, 4], and the weight of each pose, [S + 64].
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
    """Choose `count` joints per vertex, and weights for which it moves as with all joints.

    The largest weights alone would keep three bones of the spine, which move together, and drop the shoulder, which moves far.

    Args:
        weights: [V, J] non-negative, rows sum to 1.
        count: number of joints to keep; columns of zeros are added if there are fewer joints.
        vertices: [V, 3] canonical, metres.
        transforms: [S, J, 4, 4], canonical to posed: poses to fit.
        counts: [S], weight of each pose.

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
    padding = np.array([(0, 0), (0, count - kept)])
    return np.pad(chosen, padding), np.pad(best, padding)


def dense_weights(joints: NDArray[np.int64], values: NDArray[np.float32], num_joints: int) -> NDArray[np.float64]:
    """Return weights [V, K] of joints [V, K] as weights [V, J] of all joints."""
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
    """Return weights [N, C] of candidates [N, C], all but `kept` of them zero; the least important is removed first.

    With weights v that sum to 1 the error of a vertex is sum_c v_c (B_c x - y), where y is its position with all weights. Its
    square is a quadratic form of v, whose matrix G sums over the poses.
    """
    points = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1, dtype=np.float64)
    apart = np.empty((*joints.shape, len(transforms), 3))
    precise = weights.astype(np.float64)
    for pose, (matrices, share) in enumerate(zip(transforms[:, :, :3], np.sqrt(counts), strict=True)):
        blended = blend_transforms(precise, matrices)[:, None]
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
    """Return weights v [N, C], zero where not alive, that sum to 1 and minimise v G v + pull |v - prior|^2.

    Negative weights are set to zero, and the others scaled.
    """
    size = products.shape[1]
    both = alive[:, :, None] & alive[:, None, :]
    system = np.zeros((len(products), size + 1, size + 1))
    system[:, :size, :size] = np.where(both, products, 0) + np.eye(size) * np.where(alive, _PULL_M2, 1.0)[:, :, None]
    system[:, :size, size] = system[:, size, :size] = alive
    right = np.concatenate([np.where(alive, _PULL_M2 * prior, 0), np.ones((len(products), 1))], axis=1)
    found = np.linalg.solve(system, right[:, :, None])[:, :size, 0].clip(0)
    return found / found.sum(axis=1, keepdims=True)
