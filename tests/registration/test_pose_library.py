"""Poses of the built-in motions for bodies of SMPL's joints and of others."""

from __future__ import annotations

import numpy as np

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.motions import TRAINING_SEQUENCES
from snarfcli.motions.layouts import SMPL_X
from snarfcli.registration.pose_library import PoseLibrary, facing_forwards
from snarfcli.registration.rotations import matrix_to_vector, vector_to_matrix
from snarfcli.registration.solver import PosePrior


def test_all_poses_face_forwards():
    library = PoseLibrary.builtin(SMPL_JOINT_NAMES)
    assert library.poses.shape[1:] == (24, 3)
    assert len(library.poses) > 1000
    np.testing.assert_array_equal(library.poses[0], 0)  # the rest pose
    np.testing.assert_allclose(vector_to_matrix(library.poses[:, 0])[:, 0, 2], 0, atol=1e-12)


def test_facing_forwards_undoes_a_turn_about_y():
    poses = np.random.default_rng(0).normal(0, 0.4, (5, 3, 3))
    turned = poses.copy()
    turned[:, 0] = matrix_to_vector(vector_to_matrix(np.array([0.0, 2.0, 0.0])) @ vector_to_matrix(poses[:, 0]))
    np.testing.assert_allclose(facing_forwards(turned), facing_forwards(poses), atol=1e-12)


def test_motions_are_left_out():
    whole = PoseLibrary.builtin(SMPL_JOINT_NAMES)
    fewer = PoseLibrary.builtin(SMPL_JOINT_NAMES, leave_out={"splits"})
    kept = {pose.tobytes() for pose in fewer.poses}
    assert kept < {pose.tobytes() for pose in whole.poses}
    assert len(whole.poses) - len(fewer.poses) == 2 * 64  # 8 s at 8 per second, twice


def test_joints_are_found_by_name():
    smpl = PoseLibrary.builtin(SMPL_JOINT_NAMES, leave_out=TRAINING_SEQUENCES)
    smpl_x = PoseLibrary.builtin(SMPL_X, leave_out=TRAINING_SEQUENCES)
    np.testing.assert_array_equal(smpl.poses[:, :22], smpl_x.poses[:, :22])
    np.testing.assert_array_equal(smpl_x.poses[:, 22:], 0)
    backwards = PoseLibrary.builtin(SMPL_JOINT_NAMES[::-1], leave_out=TRAINING_SEQUENCES)
    assert backwards.poses.shape == smpl.poses.shape


def test_a_rig_brings_its_own_poses():
    assert PoseLibrary.of_rig(5).poses.shape == (1, 5, 3)
    own = np.random.default_rng(0).normal(0, 0.3, (4, 5, 3))
    library = PoseLibrary.of_rig(5, own)
    assert library.poses.shape == (5, 5, 3)
    np.testing.assert_array_equal(library.poses[1:, 1:], own[:, 1:])


def test_the_prior_of_the_built_in_motions_keeps_knees_from_bending_to_the_side():
    prior = PoseLibrary.builtin(SMPL_JOINT_NAMES).prior()
    knee, shoulder = SMPL_JOINT_NAMES.index("l_knee"), SMPL_JOINT_NAMES.index("l_shoulder")
    assert prior.weight[knee, 2] > 5 * prior.weight[knee, 0]
    assert prior.weight[knee, 2] > 5 * prior.weight[shoulder].max()
    assert prior.mean[knee, 0] > 0.3  # bent


def test_joints_that_never_move_and_small_libraries_have_a_weak_prior():
    weak = PosePrior.weak(55)
    fingers = PoseLibrary.builtin(SMPL_X).prior()
    np.testing.assert_array_equal(fingers.weight[25:], weak.weight[25:])
    np.testing.assert_array_equal(PoseLibrary.of_rig(55).prior().weight, weak.weight)
