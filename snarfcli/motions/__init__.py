"""Pose sequences: readers for motion files, retargeting, and the built-in motions."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.motions.body_shape import read_shape
from snarfcli.motions.builtin import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, builtin_motion
from snarfcli.motions.motion import Motion
from snarfcli.motions.reader import MOTION_SUFFIXES, read_motion

__all__ = [
    "MOTION_SUFFIXES",
    "OUT_OF_DISTRIBUTION_SEQUENCES",
    "TRAINING_SEQUENCES",
    "Motion",
    "builtin_motion",
    "read_motion",
    "read_shape",
]
