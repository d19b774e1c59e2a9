"""The posed surface against the body it is made from, and its derivatives against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from snarfcli.bodies import Skeleton, builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface, farthest_points
from snarfcli.registration.rotations import vector_to_matrix


@pytest.fixture(scope="module")
def surface() -> BodySurface:
    return BodySurface.from_body(builtin_body(), 60)


@pytest.fixture
def state() -> BodyState:
    draws = np.random.default_rng(1)
    return BodyState.from_pose(draws.normal(0, 0.3, (24, 3)), draws.normal(0, 1, 3), draws.normal(0, 1, 10))


def test_points_and_joints_are_those_of_the_body(surface, state):
    posed = surface.posed(state)
    body = builtin_body().to(torch.float64).pose(state.pose[None], state.betas, state.translation[None])
    np.testing.assert_allclose(posed.points, body.vertices[0, surface.vertex_numbers].numpy(), atol=1e-6)  # the file is float32
    np.testing.assert_allclose(posed.joints, body.joints[0].numpy(), atol=1e-6)
    np.testing.assert_allclose(surface.joints(state), posed.joints)


def test_the_derivatives_by_place_and_shape_are_exact(surface, state):
    _, derivatives = surface.posed_with_derivatives(state)
    rows = derivatives.rows(np.arange(60))
    for column in range(13):
        step = np.zeros(13)
        step[column] = 1e-4

        def moved(sign: float, step=step) -> np.ndarray:
            after = BodyState(state.rotations, state.translation + sign * step[:3], state.betas + sign * step[3:])
            return surface.posed(after).points

        np.testing.assert_allclose(rows[:, :, 72 + column], (moved(1) - moved(-1)) / 2e-4, atol=1e-7)


def test_the_derivatives_by_turns_are_exact_without_pose_correctives(surface, state):
    bare = BodySurface(**{**vars_of(surface), "correctives": np.zeros((60, 3, 0))})
    posed, derivatives = bare.posed_with_derivatives(state)
    rows = derivatives.rows(np.arange(60))
    for joint in range(24):
        for axis in range(3):
            turns = np.zeros((24, 3))
            turns[joint, axis] = 1e-5
            after, before = (
                bare.posed(BodyState(bare.turned(state, posed, sign * turns), state.translation, state.betas)).points
                for sign in (1, -1)
            )
            np.testing.assert_allclose(rows[:, :, 3 * joint + axis], (after - before) / 2e-5, atol=1e-8)


def test_normal_equations_are_sums_of_the_rows(surface, state):
    _, derivatives = surface.posed_with_derivatives(state)
    draws = np.random.default_rng(5)
    roots, pulls = draws.normal(size=(60, 3, 3)), draws.normal(size=(60, 3))
    weights = roots @ roots.transpose(0, 2, 1)
    rows = derivatives.rows(np.arange(60))
    system, gradient = derivatives.normal_equations(weights, pulls)
    np.testing.assert_allclose(system, np.einsum("kad,kab,kbe->de", rows, weights, rows), atol=1e-9)
    np.testing.assert_allclose(gradient, np.einsum("kad,ka->d", rows, pulls), atol=1e-9)


def vars_of(surface: BodySurface) -> dict:
    return {name: getattr(surface, name) for name in surface.__dataclass_fields__}


def test_normals_turn_with_the_body_as_a_whole(surface):
    state = BodyState.from_pose(np.zeros((24, 3)), np.zeros(3), np.zeros(10))
    turn = vector_to_matrix(np.array([0.3, -1.0, 0.5]))
    rotations = state.rotations.copy()
    rotations[0] = turn
    posed = surface.posed(BodyState(rotations, state.translation, state.betas))
    np.testing.assert_allclose(posed.normals, surface.normals_rest @ turn.T, atol=1e-9)


def test_a_rig_moves_by_its_weights():
    joints = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    skeleton = Skeleton(("root", "tip"), (-1, 0), joints, torch.zeros(2, 3))
    vertices = np.array([[0.1, 0.0, 0.0], [0.1, 2.0, 0.0], [-0.1, 2.0, 0.0], [0.0, 0.0, 0.1]])
    weights = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    surface = BodySurface.from_rig(skeleton, vertices, np.array([[0, 1, 2], [0, 3, 1]]), weights, 10)
    posed = surface.posed(BodyState.from_pose(np.array([[0, 0, 0], [0, 0, np.pi / 2]]), np.array([0.0, 0.0, 1.0]), np.zeros(0)))
    np.testing.assert_allclose(posed.points[:3], [[0.1, 0, 1], [-1, 1.1, 1], [-1, 0.9, 1]], atol=1e-12)


def test_farthest_points_are_spread():
    line = np.stack([np.linspace(0, 1, 101), np.zeros(101), np.zeros(101)], 1)
    assert sorted(farthest_points(line, 3)) == [0, 50, 100]
    assert farthest_points(line, 500).tolist() == list(range(101))
