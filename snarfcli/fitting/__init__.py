"""Fitting the poses of an avatar to surfaces that are seen."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.fitting.corrections import Corrections, Corrector
from snarfcli.fitting.pose_fit import CanonicalPoints, FittedPoses, PoseFit, Surfaces
from snarfcli.fitting.refined_poses import RefinedPoses, refined_poses_text
from snarfcli.fitting.refiner import PoseRefiner, require_refinable

__all__ = [
    "CanonicalPoints",
    "Corrections",
    "Corrector",
    "FittedPoses",
    "PoseFit",
    "PoseRefiner",
    "RefinedPoses",
    "Surfaces",
    "refined_poses_text",
    "require_refinable",
]
