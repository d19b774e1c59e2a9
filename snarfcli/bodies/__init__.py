"""Skeletons and bodies: rotations, forward kinematics, SMPL-format models, the built-in body (CC0-1.0)."""

from snarfcli.bodies.body import Body, PosedBody
from snarfcli.bodies.builtin import builtin_body
from snarfcli.bodies.finding import BODY_KINDS, GENDERS, BodyNotFound, find_body
from snarfcli.bodies.kinematics import (
    axis_angle_to_matrix,
    forward_kinematics,
    invert_rigid,
    matrix_to_axis_angle,
    pose_from_transforms,
)
from snarfcli.bodies.model_files import load_body
from snarfcli.bodies.skeleton import SMPL_JOINT_NAMES, SMPLH_JOINT_NAMES, SMPLX_JOINT_NAMES, Skeleton, legs_apart_pose
from snarfcli.bodies.template import MeshTemplate

__all__ = [
    "BODY_KINDS",
    "GENDERS",
    "SMPLH_JOINT_NAMES",
    "SMPLX_JOINT_NAMES",
    "SMPL_JOINT_NAMES",
    "Body",
    "BodyNotFound",
    "MeshTemplate",
    "PosedBody",
    "Skeleton",
    "axis_angle_to_matrix",
    "builtin_body",
    "find_body",
    "forward_kinematics",
    "invert_rigid",
    "legs_apart_pose",
    "load_body",
    "matrix_to_axis_angle",
    "pose_from_transforms",
]
