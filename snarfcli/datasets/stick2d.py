"""The two-dimensional stick of SNARF Sec. 4.1 and 4.3: two bones in the plane z = 0, with or without a rigid object.

The paper gives the weights (inverse distances to the bones) and the angles. The sizes, the object and the number of poses are
chosen here.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.datasets.posed_meshes import RigMeshes
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import Split
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.errors import UserError, nearest
from snarfcli.motions import Motion

__all__ = ["STICK_STEPS_DEG", "STICK_SUBJECTS", "load", "stick_subject", "stick_weights", "subjects"]

STICK_STEPS_DEG = {"stick_step10": 10, "stick_step20": 20, "stick_step30": 30, "stick_step60": 60}
"""Subjects for interpolation. Their training angles form a regular lattice; the value is its step, degrees."""

STICK_SUBJECTS = ("stick", "stick_object", *STICK_STEPS_DEG)
"""`stick`, `stick_object` (with a rigid object that the stick reaches) and the subjects for interpolation."""

_HALF_WIDTH_M, _HALF_LENGTH_M = 0.15, 0.8  # of the stick: a person's size, as the training settings expect
_REACH_M = 0.7  # length of each bone; they meet at the middle joint and end inside the stick
_CELLS = (24, 128)  # quadrilaterals across and along, 12.5 mm each; even across, so that a column of vertices is on the bones
_HALF_HEIGHT_M = 0.02  # of the prism along z; thin, so that the nodes of the weight grid lie in the plane z = 0
_OBJECT_AT_M, _OBJECT_RADIUS_M, _OBJECT_SIDES, _OBJECT_RINGS = (0.5, -0.4), 0.2, 96, 8
_MIN_DISTANCE_M = 1e-9  # to a bone, against division by zero; a point on one bone gets weight 1 for it

_TRAINED_DEG, _FARTHEST_DEG = 60.0, 120.0  # largest angle of a joint in training and out of distribution, SNARF Sec. 4.3
_TRAIN_FRAMES, _TEST_FRAMES = 120, 60  # number of frames; as many out of distribution as for testing
_FRAME_RATE = 30.0  # arbitrary, since the frames have no order in time
_LOWER, _UPPER, _OBJECT = 1, 2, 4  # indices of joints


def subjects(request: Request) -> tuple[str, ...]:
    """Return the names of the sticks, `STICK_SUBJECTS`."""
    return STICK_SUBJECTS


def load(subject: str, request: Request) -> SubjectData:
    """Return one of the sticks.

    Raises:
        UserError: there is no such stick, or a body is given.
    """
    if request.body is not None:
        raise UserError("data=stick2d has no body model; leave out body=")
    return stick_subject(subject)


def stick_subject(subject: str) -> SubjectData:
    """Return one of `STICK_SUBJECTS`; the result depends only on the name.

    Joints: `root` at the lower end, which never rotates; `lower` at the same place and `upper` in the middle, which rotate the
    two bones about z; `tip` at the end of the upper bone; and `object`, a second root that does not move.

    Raises:
        UserError: there is no such stick.
    """
    if subject not in STICK_SUBJECTS:
        raise UserError(f"no stick '{subject}'{nearest(subject, STICK_SUBJECTS)}; wanted one of {', '.join(STICK_SUBJECTS)}")
    has_object = subject == "stick_object"
    skeleton = _skeleton(has_object)
    shapes = [_strip(), *([_disk()] if has_object else [])]
    template = _prisms(shapes, skeleton.num_joints)
    generator = np.random.default_rng(6021)  # the same seed for all, so that `stick` and `stick_object` have the same poses
    angles: dict[Split, NDArray[np.float64]] = {
        "train": _training_angles(STICK_STEPS_DEG.get(subject), generator),
        "test": _angles_in_range(_TEST_FRAMES, generator),
        "ood": _angles_beyond_range(_TEST_FRAMES, generator),
    }
    names: dict[Split, str] = {"train": "bend", "test": "bend_anew", "ood": "bend_further"}
    sequences = tuple(_sequence(names[split], split, values, skeleton, template) for split, values in angles.items())
    sources = ("the stick of SNARF Sec. 4.1, generated",)
    return SubjectData("stick2d", subject, skeleton, sequences, template, sources=sources, is_planar=True)


def stick_weights(points: NDArray) -> NDArray[np.float64]:
    """Return the skinning weights of the stick.

    Args:
        points: [..., 2], canonical frame, metres.

    Returns:
        [..., 2], weights of the lower and the upper bone.

    Source: SNARF Sec. 4.1, "the inverse of its distance to each bone", normalised.
    """
    lower, middle, upper = (np.array([0.0, y]) for y in (-_REACH_M, 0.0, _REACH_M))
    distances = [_distance(np.asarray(points, np.float64), *ends) for ends in ((lower, middle), (middle, upper))]
    inverse = 1.0 / np.maximum(np.stack(distances, -1), _MIN_DISTANCE_M)
    return inverse / inverse.sum(-1, keepdims=True)


def _distance(points: NDArray, start: NDArray, end: NDArray) -> NDArray:
    """Return the distances [...] of points [..., 2] to a segment."""
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(points - start - share[..., None] * along, axis=-1)


def _skeleton(has_object: bool) -> Skeleton:
    """Return the joints that `stick_subject` describes; the canonical pose is the rest pose."""
    names, parents = ["root", "lower", "upper", "tip"], [-1, 0, 1, 2]
    joints = [[0.0, -_REACH_M, 0.0], [0.0, -_REACH_M, 0.0], [0.0, 0.0, 0.0], [0.0, _REACH_M, 0.0]]
    if has_object:
        names, parents, joints = [*names, "object"], [*parents, -1], [*joints, [*_OBJECT_AT_M, 0.0]]
    rest = torch.tensor(joints, dtype=torch.float64)
    return Skeleton(tuple(names), tuple(parents), rest, torch.zeros_like(rest))


# A flat shape: points [V, 2], metres; counterclockwise triangles [F, 3]; indices of the points on its outline,
# counterclockwise; weights [V, K]; and the indices of the K joints that move it.
_Flat = tuple[NDArray, NDArray, NDArray, NDArray, list[int]]


def _strip() -> _Flat:
    """Return the stick: a strip of quadrilaterals, each cut into two triangles."""
    across, along = _CELLS
    x, y = np.linspace(-_HALF_WIDTH_M, _HALF_WIDTH_M, across + 1), np.linspace(-_HALF_LENGTH_M, _HALF_LENGTH_M, along + 1)
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    number = np.arange(len(points)).reshape(along + 1, across + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    outline = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    return points, triangles, outline, stick_weights(points), [_LOWER, _UPPER]


def _disk() -> _Flat:
    """Return the object: a disk, made of rings of quadrilaterals around a fan of triangles."""
    turn = 2 * np.pi * np.arange(_OBJECT_SIDES) / _OBJECT_SIDES
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    radii = _OBJECT_RADIUS_M * np.arange(1, _OBJECT_RINGS + 1) / _OBJECT_RINGS
    points = np.array(_OBJECT_AT_M) + np.concatenate([np.zeros((1, 2)), (radii[:, None, None] * circle).reshape(-1, 2)])
    number = 1 + np.arange(_OBJECT_RINGS * _OBJECT_SIDES).reshape(_OBJECT_RINGS, _OBJECT_SIDES)
    following = np.roll(number, -1, axis=1)
    a, b, c, d = number[:-1], number[1:], following[1:], following[:-1]
    middle = np.stack([np.zeros_like(number[0]), number[0], following[0]], -1)
    rings = [np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return points, np.concatenate([middle, *rings]), number[-1], np.ones((len(points), 1)), [_OBJECT]


def _prisms(shapes: list[_Flat], num_joints: int) -> MeshTemplate:
    """Return flat shapes as closed prisms along z, centred at z = 0.

    Their walls have two rows of quadrilaterals, so that the middle vertices are at z = 0.
    """
    vertices, faces, weights, count = [], [], [], 0
    for points, triangles, outline, own_weights, joints in shapes:
        flat = len(points)
        levels = [(points, -_HALF_HEIGHT_M), (points, _HALF_HEIGHT_M), (points[outline], 0.0)]
        vertices += [np.column_stack([level, np.full(len(level), z)]) for level, z in levels]
        rows = [outline, 2 * flat + np.arange(len(outline)), flat + outline]
        walls = []
        for low, high in itertools.pairwise(rows):
            a, b, c, d = low, np.roll(low, -1), np.roll(high, -1), high
            walls += [np.stack([a, b, c], -1), np.stack([a, c, d], -1)]
        faces.append(count + np.concatenate([triangles[:, ::-1], flat + triangles, *walls]))
        all_weights = np.zeros((2 * flat + len(outline), num_joints))
        all_weights[:, joints] = np.concatenate([own_weights, own_weights, own_weights[outline]])
        weights.append(all_weights)
        count += len(all_weights)
    joined = np.concatenate(vertices), np.concatenate(faces).astype(np.int32), np.concatenate(weights)
    return MeshTemplate(*joined, is_planar=True)


def _angles_in_range(count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return random angles [count, 2] of the two joints within the range of training, degrees."""
    return generator.uniform(-_TRAINED_DEG, _TRAINED_DEG, (count, 2))


def _angles_beyond_range(count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return random angles [count, 2] of the two joints, each beyond the range of training, degrees."""
    return generator.uniform(_TRAINED_DEG, _FARTHEST_DEG, (count, 2)) * generator.choice([-1.0, 1.0], (count, 2))


def _training_angles(step_deg: int | None, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return the angles [T, 2] of the training sequence, degrees.

    Its last tenth, which is for validation, is always random.

    Args:
        step_deg: step of a lattice of angles; None for random angles.
        generator: source of the random numbers.
    """
    if step_deg is None:
        trained = _angles_in_range(_TRAIN_FRAMES, generator)
    else:
        values = np.arange(-_TRAINED_DEG, _TRAINED_DEG + 1, step_deg)
        trained = generator.permutation(np.stack(np.meshgrid(values, values), -1).reshape(-1, 2))
    return np.concatenate([trained, _angles_in_range(max(1, round(len(trained) / 9)), generator)])


def _sequence(name: str, split: Split, angles: NDArray[np.float64], skeleton: Skeleton, template: MeshTemplate) -> SequenceSpec:
    """Return a sequence with the joint angles [T, 2], degrees, about z."""
    poses = np.zeros((len(angles), skeleton.num_joints, 3))
    poses[:, [_LOWER, _UPPER], 2] = np.deg2rad(angles)
    motion = Motion(name, poses, np.zeros((len(angles), 3)), _FRAME_RATE)
    posed_from_rest = skeleton.posed_from_rest(torch.from_numpy(poses)).numpy()
    return SequenceSpec(name, split, motion, RigMeshes(template.vertices, template.faces, template.weights, posed_from_rest))
