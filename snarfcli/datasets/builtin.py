"""The built-in data set: ten subjects with DFaust's ids, each with its shape and style of motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies import SMPL_JOINT_NAMES, Body, builtin_body, find_body, load_body
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import Split
from snarfcli.datasets.subjects import SubjectData, body_sequence, body_template
from snarfcli.errors import UserError, nearest
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, builtin_motion

__all__ = ["BUILTIN_SUBJECTS", "HELD_OUT_SEQUENCES", "builtin_subject", "load", "require_subject", "subjects"]

HELD_OUT_SEQUENCES = {
    "50002": "chicken_wings",
    "50004": "hips",
    "50007": "jiggle_on_toes",
    "50009": "jumping_jacks",
    "50020": "knees",
    "50021": "light_hopping_stiff",
    "50022": "light_hopping_loose",
    "50025": "one_leg_jump",
    "50026": "one_leg_loose",
    "50027": "punching",
}
"""The test sequence of each subject, as in the split of SNARF and Fast-SNARF."""

BUILTIN_SUBJECTS = tuple(HELD_OUT_SEQUENCES)
"""Ids of the built-in subjects, those of DFaust."""

_SEQUENCES_PER_SUBJECT = 10
_NUM_BETAS = 10
_GENDER = "neutral"


def _betas(subject: str, count: int) -> NDArray[np.float64]:
    # The shape space is scaled to the standard normal distribution; 0.9 and the clip give ordinary adults.
    return np.clip(0.9 * np.random.default_rng([int(subject), 1]).standard_normal(count), -2.0, 2.0)


def _leg_length(body: Body, betas: NDArray[np.float64] | None) -> float:
    """Return the height of the pelvis above the soles in the rest pose, metres."""
    vertices, joints = body.shaped(betas)
    return float(joints[0, 1] - vertices[:, 1].min())


def _sequence_names(subject: str) -> tuple[str, ...]:
    """Return the ten sequences of a subject, including the held-out one, in the order of TRAINING_SEQUENCES."""
    held_out = HELD_OUT_SEQUENCES[subject]
    others = [name for name in TRAINING_SEQUENCES if name != held_out]
    chosen = np.random.default_rng([int(subject), 2]).permutation(others)[: _SEQUENCES_PER_SUBJECT - 1]
    return tuple(name for name in TRAINING_SEQUENCES if name == held_out or name in chosen)


def require_subject(subject: str) -> None:
    """Check the id of a built-in subject.

    Raises:
        UserError: it is not in `BUILTIN_SUBJECTS`.
    """
    if subject not in HELD_OUT_SEQUENCES:
        hint = nearest(subject, BUILTIN_SUBJECTS) or "."
        raise UserError(f"no built-in subject '{subject}'{hint} Wanted one of {', '.join(BUILTIN_SUBJECTS)}")


def subjects(request: Request) -> tuple[str, ...]:
    """Return the ids of the built-in subjects."""
    return BUILTIN_SUBJECTS


def load(subject: str, request: Request) -> SubjectData:
    """Return a built-in subject with the built-in body or the requested one."""
    if request.body is None:
        return builtin_subject(subject)
    require_subject(subject)
    path = find_body(request.body, "smpl", _GENDER)
    return builtin_subject(subject, load_body(path), f"body {path}")


def builtin_subject(subject: str | int, body: Body | None = None, source: str = "") -> SubjectData:
    """Return a built-in subject; the result depends only on the arguments.

    Args:
        subject: one of `BUILTIN_SUBJECTS`.
        body: an SMPL body instead of the built-in one.
        source: origin of that body, for the manifest.

    Raises:
        UserError: there is no such subject, or the body does not have SMPL's joints.
    """
    subject = str(subject)
    require_subject(subject)
    body = body or builtin_body()
    if body.joint_names != SMPL_JOINT_NAMES:
        raise UserError(f"body: wanted SMPL's 24 joints for the built-in motions, got {body.num_joints}; give an SMPL body")
    betas = _betas(subject, min(body.num_betas, _NUM_BETAS))
    held_out = HELD_OUT_SEQUENCES[subject]
    names = _sequence_names(subject)
    splits: list[tuple[str, Split]] = [(name, "train") for name in names if name != held_out]
    splits.append((held_out, "test"))
    splits.extend((name, "ood") for name in OUT_OF_DISTRIBUTION_SEQUENCES)
    size = _leg_length(body, betas) / _leg_length(body, None)
    sequences = []
    for name, split in splits:
        motion = builtin_motion(name, int(subject))
        # Steps and hops are scaled by the length of the legs, so that the feet stay on the floor.
        motion = replace(motion, translation=motion.translation * size)
        sequences.append(body_sequence(name, split, motion, body, betas))
    skeleton = body.skeleton(betas)
    template = body_template(body, betas, skeleton)
    sources = (source or "the built-in body (CC0)", "built-in motions (CC0)")
    return SubjectData("builtin", subject, skeleton, tuple(sequences), template, betas, sources)
