"""Limbs of bodies, and the search for those that lie wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from body_scans import body_scan

from snarfcli.bodies import SMPL_JOINT_NAMES, builtin_body
from snarfcli.motions import builtin_motion
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.joint_limits import random_poses
from snarfcli.registration.limbs import Limb, doubtful_limbs, find_limbs, limb_candidates, squared_distances
from snarfcli.registration.matches import agreement
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.rotations import vector_to_matrix
from snarfcli.registration.scan_grid import ScanGrid

NUMBER = {name: number for number, name in enumerate(SMPL_JOINT_NAMES)}


@pytest.fixture(scope="module")
def surface() -> BodySurface:
    return BodySurface.from_body(builtin_body(), 900)


@pytest.fixture(scope="module")
def limbs(surface) -> list[Limb]:
    library = PoseLibrary.builtin(SMPL_JOINT_NAMES, leave_out={"punching"}).poses[::4]
    by_chance = random_poses(SMPL_JOINT_NAMES, 300)
    assert by_chance is not None
    return find_limbs(surface, vector_to_matrix(library), vector_to_matrix(by_chance))


@pytest.fixture(scope="module")
def truth() -> BodyState:
    motion = builtin_motion("punching", 3, frame_rate=10)
    return BodyState.from_pose(motion.poses[15], motion.translation[15], np.zeros(10))


WRONG = {"l_collar": {"l_shoulder": (0.0, 0.0, 0.0), "l_elbow": (0.0, 0.0, 0.0)}, "r_hip": {"r_hip": (-1.5, 0.0, 0.0)}}
"""Turns of joints, by the first joint of the limb that they make lie wrong."""


def with_wrong_limb(state: BodyState, first: str) -> BodyState:
    rotations = state.rotations.copy()
    for name, turn in WRONG[first].items():
        rotations[NUMBER[name]] = vector_to_matrix(np.array(turn))
    return BodyState(rotations, state.translation, state.betas)


def by_first_joint(limbs: list[Limb]) -> dict[str, Limb]:
    return {SMPL_JOINT_NAMES[limb.joints[0]]: limb for limb in limbs}


def test_a_person_has_arms_legs_a_head_and_an_upper_body_and_halves_of_limbs(limbs):
    found = by_first_joint(limbs)
    assert set(found) == {"l_hip", "r_hip", "spine1", "neck", "l_collar", "r_collar", "l_knee", "r_knee", "l_elbow", "r_elbow"}
    assert [SMPL_JOINT_NAMES[joint] for joint in found["l_elbow"].joints] == ["l_elbow", "l_wrist", "l_hand"]
    assert found["r_hip"].rotations.shape == (250, 4, 3, 3)


def test_fingers_do_not_hide_an_arm(surface):
    wrist = NUMBER["l_wrist"]
    fingers = replace(
        surface,
        joint_names=(*surface.joint_names, "l_index1", "l_ring1"),
        parents=(*surface.parents, wrist, wrist),
        joints_rest=np.concatenate([surface.joints_rest, surface.joints_rest[[wrist, wrist]] + 0.03]),
        joints_by_beta=np.concatenate([surface.joints_by_beta, surface.joints_by_beta[[wrist, wrist]]]),
        weights=np.concatenate([surface.weights, np.zeros((len(surface.weights), 2))], 1),
    )
    poses = np.tile(np.eye(3), (2, 26, 1, 1))
    found = {fingers.joint_names[limb.joints[0]]: limb for limb in find_limbs(fingers, poses, poses)}
    assert [fingers.joint_names[joint] for joint in found["l_elbow"].joints] == [
        "l_elbow", "l_wrist", "l_hand", "l_index1", "l_ring1",
    ]  # fmt: skip
    assert "l_index1" not in found


def test_a_chain_has_no_limbs(surface):
    chain = BodySurface(
        ("a", "b"), (-1, 0), np.zeros((2, 3)), np.zeros((2, 3, 0)), np.zeros((4, 3)), np.zeros((4, 3, 0)), np.zeros((4, 3)),
        np.full((4, 2), 0.5), np.zeros((4, 3, 0)), np.arange(4),
    )  # fmt: skip
    assert find_limbs(chain, np.zeros((3, 2, 3, 3)), None) == []


def test_no_limb_of_a_good_fit_is_doubtful(surface, limbs, truth):
    assert doubtful_limbs(surface, limbs, agreement(surface, truth, body_scan(truth, 4000))) == []


@pytest.mark.parametrize("first", WRONG)
def test_a_wrong_limb_is_doubtful_and_gets_better_candidates(surface, limbs, truth, first):
    limb = by_first_joint(limbs)[first]
    scan = body_scan(truth, 4000)
    wrong = with_wrong_limb(truth, first)
    assert limb in doubtful_limbs(surface, limbs, agreement(surface, wrong, scan))
    candidates = limb_candidates(surface, wrong, limb, ScanGrid(scan), 3)
    assert len(candidates) == 3
    before, *after = (
        np.linalg.norm(surface.joints(state)[limb.joints] - surface.joints(truth)[limb.joints], axis=1).mean()
        for state in (wrong, *candidates)
    )
    assert min(after) < 0.6 * before
    others = np.setdiff1d(np.arange(24), limb.joints)
    for state in candidates:
        np.testing.assert_array_equal(state.rotations[others], wrong.rotations[others])


def test_squared_distances():
    draws = np.random.default_rng(0)
    one, other = draws.normal(size=(5, 6)), draws.normal(size=(7, 6))
    np.testing.assert_allclose(squared_distances(one, other), np.square(one[:, None] - other).sum(2), atol=1e-12)
