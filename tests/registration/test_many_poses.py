"""Many poses at once against one at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from snarfcli.bodies import builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.kinematics import kinematics
from snarfcli.registration.many_poses import posed_many
from snarfcli.registration.rotations import vector_to_matrix


def test_points_normals_and_joints_are_those_of_single_poses():
    whole = BodySurface.from_body(builtin_body(), 40)
    surface = replace(whole, correctives=np.zeros((40, 3, 0)))
    draws = np.random.default_rng(0)
    poses, betas = draws.normal(0, 0.4, (3, 24, 3)), draws.normal(0, 1, 10)
    points, normals = posed_many(surface, vector_to_matrix(poses), betas)
    turns, joints = kinematics(surface.parents, surface.rest_joints(betas), vector_to_matrix(poses))
    for number, pose in enumerate(poses):
        one = surface.posed(BodyState.from_pose(pose, np.zeros(3), betas))
        np.testing.assert_allclose(points[number], one.points, atol=1e-12)
        np.testing.assert_allclose(normals[number], one.normals, atol=1e-12)
        np.testing.assert_allclose(joints[number], one.joints, atol=1e-12)
        np.testing.assert_allclose(turns[number], one.turns, atol=1e-12)
