"""The best rigid pieces of the 2D stick: the limit of `model=piecewise`, found without a network.

    python benchmarks/bm_rigid_pieces.py          makes its samples itself

A piece is a set of square cells in the frame of its bone. Each piece in turn is the best one for the training frames while the
others stay: it has the cells in which more points are inside than outside, of the points that no other piece covers. The steps
of 60 degrees are too few frames for cells of this size.

The weights of the stick are the inverse distances to its bones (SNARF Sec. 4.1). At a side distance x from the axis and a
distance d along it from the joint, the other bone has a weight of about x / d, and moves the point by d sin(angle) more: every
cross-section shifts sideways by x sin(angle), at any distance from the joint. `--powers 2` uses the inverse squared distances,
with which this shift falls with the distance from the joint.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from common import arguments, print_machine, print_table
from numpy.typing import NDArray

from snarfcli.datasets.posed_meshes import RigMeshes
from snarfcli.datasets.stick2d import STICK_SUBJECTS, stick_subject
from snarfcli.evaluation.metrics import iou
from snarfcli.progress import progress
from snarfcli.sampling.cube import dequantise
from snarfcli.sampling.points import SamplingSettings, frame_generator, sample_frame

_CELL_M, _REACH_M = 0.02, 1.2  # side of a cell, and of a piece from its bone's joint, along each axis
_SIDE = round(2 * _REACH_M / _CELL_M)
_BEYOND = _SIDE * _SIDE  # number of the cell beyond all others
_ROUNDS = 6  # after the third nothing changes by more than 0.1 points
_LOWER, _UPPER, _OBJECT = 1, 2, 4  # joints of the pieces
_SETTINGS = SamplingSettings(
    points_per_frame=8000, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0, is_planar=True
)


@dataclass(frozen=True)
class FramePoints:
    """Labelled points of one frame: the first half uniform, the second half near the outline."""

    cells: NDArray[np.int64]
    """[K, N], cell of each point in the frame of each of K bones; the last cell is everything beyond."""
    inside: NDArray[np.bool_]
    """[N]."""


def main() -> None:
    options = arguments(
        "The best rigid pieces of the 2D stick.",
        subjects={"nargs": "+", "default": ["stick", "stick_object"], "choices": STICK_SUBJECTS,
                  "help": "sticks"},
        powers={"nargs": "+", "type": float, "default": [1.0, 2.0], "help": "weights: inverse distances to this power"},
    )  # fmt: skip
    print_machine()
    rows = []
    cases = list(itertools.product(options.subjects, options.powers))
    for subject, power in progress(cases, desc="sticks"):
        frames = _frames(subject, power)
        pieces = _best_pieces(frames["train"])
        scores = [f"{100 * value:.1f}" for split in ("test", "ood") for value in _scores(pieces, frames[split])]
        rows.append([subject, f"{power:g}", *scores])
    print_table(["subject", "power", "bbox in %", "surface in %", "bbox out %", "surface out %"], rows)


def _frames(subject: str, power: float) -> dict[str, list[FramePoints]]:
    """Return the points of a stick whose weights are inverse distances to a power, by split; validation frames are left out."""
    data = stick_subject(subject)
    if data.template is None:
        raise ValueError(f"subject {subject}: wanted a mesh with weights, got none")
    joints = data.skeleton.canonical_joints.numpy()
    bones = [joint for joint in (_LOWER, _UPPER, _OBJECT) if joint < len(joints)]
    weights = data.template.weights**power
    weights /= weights.sum(1, keepdims=True)
    found: dict[str, list[FramePoints]] = {}
    for sequence in data.sequences:
        transforms = data.skeleton.posed_from_rest(torch.from_numpy(sequence.motion.poses)).numpy()
        meshes = RigMeshes(data.template.vertices, data.template.faces, weights, transforms)
        count = round(len(meshes) * 0.9) if sequence.split == "train" else len(meshes)
        found[sequence.split] = []
        for frame in range(count):
            drawn = sample_frame(*meshes[frame], _SETTINGS, frame_generator(0, subject, sequence.name, frame))
            points = dequantise(drawn.points, drawn.cube_lower, drawn.cube_size).astype(np.float64)
            cells = np.stack([_cells(points, transforms[frame, bone], joints[bone]) for bone in bones])
            found[sequence.split].append(FramePoints(cells, drawn.occupied))
    return found


def _cells(points: NDArray, transform: NDArray, joint: NDArray) -> NDArray[np.int64]:
    """Return the cell of each posed point [N, 3] in the frame of a bone, around its joint."""
    local = (points - transform[:3, 3]) @ transform[:3, :3] - joint
    index = np.floor((local[:, :2] + _REACH_M) / _CELL_M).astype(np.int64)
    is_beyond = ((index < 0) | (index >= _SIDE)).any(1)
    return np.where(is_beyond, _BEYOND, index[:, 0] * _SIDE + index[:, 1])


def _best_pieces(frames: list[FramePoints]) -> NDArray[np.bool_]:
    """Return the cells of the best piece of each bone [K, C] for uniform points, each while the others stay."""
    uniform = len(frames[0].inside) // 2
    cells = np.concatenate([frame.cells[:, :uniform] for frame in frames], 1)
    inside = np.concatenate([frame.inside[:uniform] for frame in frames])
    pieces = np.zeros((len(cells), _BEYOND + 1), bool)
    for round_ in range(1 + _ROUNDS):
        for bone, own in enumerate(cells):
            others = [other for other in range(len(cells)) if other != bone and round_ > 0]
            is_free = ~_covered(pieces[others], cells[others])
            votes = np.where(inside[is_free], 1, -1)
            pieces[bone] = np.bincount(own[is_free], votes, _BEYOND + 1) > 0
            pieces[bone, _BEYOND] = False
    return pieces


def _covered(pieces: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which points, by their cells [K, N], are in any of K pieces."""
    return np.logical_or.reduce(np.take_along_axis(pieces, cells, 1), axis=0)


def _scores(pieces: NDArray[np.bool_], frames: list[FramePoints]) -> tuple[float, float]:
    """Return the IoU of uniform points and of points near the outline, mean over frames, 0 to 1."""
    uniform = len(frames[0].inside) // 2
    values = []
    for frame in frames:
        predicted = _covered(pieces, frame.cells)
        values.append([iou(predicted[part], frame.inside[part]) for part in (slice(uniform), slice(uniform, None))])
    both = np.mean(values, 0)
    return float(both[0]), float(both[1])


if __name__ == "__main__":
    main()
