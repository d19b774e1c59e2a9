"""The built-in motions: procedural substitutes for the exercises of DFaust and the extreme poses of PosePrior."""

from __future__ import annotations

import zlib

import numpy as np

from snarfcli.errors import UserError, nearest
from snarfcli.motions.anatomy import poses_from_angles
from snarfcli.motions.curves import Style
from snarfcli.motions.exercises_standing import STANDING_EXERCISES
from snarfcli.motions.exercises_stepping import STEPPING_EXERCISES
from snarfcli.motions.extremes import EXTREMES, perform
from snarfcli.motions.footing import plant_foot, stand_on_floor
from snarfcli.motions.motion import Motion

__all__ = ["OUT_OF_DISTRIBUTION_SEQUENCES", "TRAINING_SEQUENCES", "builtin_motion"]

_EXERCISE_S = 4.0
_EXTREME_S = 8.0  # key poses at the pace of a stretching exercise

_EXERCISES = STANDING_EXERCISES | STEPPING_EXERCISES

TRAINING_SEQUENCES: tuple[str, ...] = tuple(sorted(_EXERCISES))
"""Exercises, with the names of DFaust."""
OUT_OF_DISTRIBUTION_SEQUENCES: tuple[str, ...] = tuple(EXTREMES)
"""Extreme poses inside the limits of the joints, in place of the seven sequences of PosePrior."""


def builtin_motion(name: str, seed: int = 0, *, duration_s: float | None = None, frame_rate: float = 60.0) -> Motion:
    """Return a motion of SMPL's 24 joints: y up, facing +z, on the spot, feet on the floor.

    Args:
        name: one of `TRAINING_SEQUENCES` or `OUT_OF_DISTRIBUTION_SEQUENCES`.
        seed: determines amplitudes, tempo, phase and noise. The same seed gives the same motion at every frame rate.
        duration_s: length in seconds; 4 for exercises and 8 for extremes by default.
        frame_rate: frames per second.

    Raises:
        UserError: there is no motion of this name.
        ValueError: the duration or frame rate is not positive, or the duration is shorter than one frame.
    """
    if name not in _EXERCISES and name not in EXTREMES:
        known = (*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES)
        raise UserError(f"no built-in motion '{name}'{nearest(name, known) or '.'} Wanted one of {', '.join(known)}")
    if duration_s is None:
        duration_s = _EXERCISE_S if name in _EXERCISES else _EXTREME_S
    frames = round(duration_s * frame_rate) if duration_s > 0 and frame_rate > 0 else 0
    if frames < 1:
        raise ValueError(f"duration_s, frame_rate: wanted at least one frame, got {duration_s} s at {frame_rate} per second")
    t = np.arange(frames) / frame_rate
    style = Style(np.random.default_rng([seed, zlib.crc32(name.encode())]))
    exercise = _EXERCISES[name](style, t) if name in _EXERCISES else perform(EXTREMES[name], style, t, duration_s)
    poses = poses_from_angles(exercise.angles, frames)
    if exercise.feet:
        translation = exercise.pelvis
        for side, path in exercise.feet.items():
            poses = plant_foot(poses, translation, side, path)
    else:
        translation = stand_on_floor(poses, frame_rate) + exercise.pelvis
    return Motion(name, poses, translation, float(frame_rate))
