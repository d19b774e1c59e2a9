"""Pose sequences: AMASS-style files and the built-in motions."""

from snarfcli.motions.amass import read_motion
from snarfcli.motions.builtin import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, builtin_motion
from snarfcli.motions.motion import Motion

__all__ = ["OUT_OF_DISTRIBUTION_SEQUENCES", "TRAINING_SEQUENCES", "Motion", "builtin_motion", "read_motion"]
