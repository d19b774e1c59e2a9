"""Shape, correctives and skinning, vertex by vertex in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from snarfcli.bodies import builtin_body


@pytest.fixture(scope="module")
def body():
    return builtin_body(torch.float64)


def random_inputs(batch=2, seed=0):
    rng = np.random.default_rng(seed)
    return 0.5 * rng.normal(size=(batch, 24, 3)), rng.normal(size=10), rng.normal(size=(batch, 3))


def reference_vertex(body, vertex, pose, betas, translation):
    """SMPL's equations, written out for one vertex of one pose."""
    shaped = body.v_template.numpy() + body.shapedirs.numpy() @ betas
    joints = body.joint_regressor.numpy() @ shaped
    rotations = [Rotation.from_rotvec(vector) for vector in pose]
    feature = np.concatenate([(rotation.as_matrix() - np.eye(3)).ravel() for rotation in rotations[1:]])
    point = shaped[vertex] + body.posedirs[vertex].numpy() @ feature
    placed = []
    for joint, parent in enumerate(body.parents):
        if parent < 0:
            placed.append((rotations[0], joints[0] + translation))
        else:
            turn, at = placed[parent]
            placed.append((turn * rotations[joint], at + turn.apply(joints[joint] - joints[parent])))
    weights = body.weights[vertex].numpy()
    return sum(w * (turn.apply(point - rest) + at) for w, (turn, at), rest in zip(weights, placed, joints, strict=True))


def test_pose_agrees_with_the_equations(body):
    pose, betas, translation = random_inputs()
    posed = body.pose(pose, betas, translation)
    assert posed.vertices.shape == (2, 6890, 3)
    for vertex in np.random.default_rng(1).choice(6890, 25, replace=False):
        for frame in range(2):
            expected = reference_vertex(body, vertex, pose[frame], betas, translation[frame])
            np.testing.assert_allclose(posed.vertices[frame, vertex], expected, atol=1e-12)


def test_rest_pose_is_the_shaped_template(body):
    _, betas, _ = random_inputs()
    v_shaped, joints = body.shaped(betas)
    posed = body.pose(torch.zeros(1, 24, 3), betas)
    torch.testing.assert_close(posed.vertices[0], v_shaped)
    torch.testing.assert_close(posed.joints[0], joints)
    torch.testing.assert_close(body.skeleton(betas).joints_rest, joints)
    short, padded = body.shaped(betas[:3])[0], body.shaped(np.append(betas[:3], np.zeros(7)))[0]
    torch.testing.assert_close(short, padded)


def test_global_turn_is_rigid(body):
    pose, betas, _ = random_inputs()
    pose[1] = pose[0]
    pose[0, 0], pose[1, 0] = 0, [0.3, -1.2, 0.5]
    posed = body.pose(pose, betas)
    root = body.shaped(betas)[1][0].numpy()
    turned = Rotation.from_rotvec(pose[1, 0]).apply(posed.vertices[0].numpy() - root) + root
    # the weights are stored in float32, so their rows sum to 1 within 1e-7
    np.testing.assert_allclose(posed.vertices[1], turned, rtol=0, atol=1e-7)


def test_float32_stays_close(body):
    pose, betas, translation = random_inputs()
    single = builtin_body().pose(pose, betas, translation).vertices
    assert single.dtype == torch.float32
    # metres; 24 transforms of size 1 chained nine deep, measured worst 6e-7
    torch.testing.assert_close(single.double(), body.pose(pose, betas, translation).vertices, atol=3e-6, rtol=0)


def test_gradients_reach_pose_and_shape(body):
    pose = torch.zeros(1, 24, 3, dtype=torch.float64, requires_grad=True)
    betas = torch.zeros(10, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(6890, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def loss(p, b):
        return (body.pose(p, b).vertices * weight).sum()

    loss(pose, betas).backward()
    for tensor, index in ((pose, (0, 18, 1)), (pose, (0, 0, 2)), (betas, (0,))):
        step = torch.zeros_like(tensor)
        step[index] = 1e-6
        with torch.no_grad():
            ends = [loss(pose + sign * step, betas) if tensor is pose else loss(pose, betas + sign * step) for sign in (1, -1)]
        assert tensor.grad[index].item() == pytest.approx((ends[0] - ends[1]).item() / 2e-6, rel=1e-5)


def test_builtin_body_is_sound(body):
    edges = torch.cat([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]]).tolist()
    directed = {tuple(edge) for edge in edges}
    assert len(directed) == len(edges)
    assert all((b, a) in directed for a, b in directed)
    triangles = body.v_template[body.faces]
    assert torch.linalg.det(triangles).sum() / 6 > 0.05  # volume in cubic metres: outward
    torch.testing.assert_close(body.weights.sum(1), torch.ones(6890, dtype=torch.float64), atol=1e-6, rtol=0)
    assert body.num_joints == 24
    assert body.num_betas == 10
    height = np.ptp(body.v_template[:, 1].numpy())
    assert 1.5 < height < 1.9
    assert body.joint_names[4] == "l_knee"
    assert body.shaped()[1][4, 0] > 0
    assert body.to(torch.float32).v_template.dtype == torch.float32
    assert body.to(torch.float32).faces.dtype == torch.int64


def test_wrong_arguments(body):
    with pytest.raises(ValueError, match=r"betas: wanted at most 10 values \[S\], got shape \[11\]"):
        body.shaped(torch.zeros(11))
    with pytest.raises(ValueError, match=r"pose: wanted shape \[B, 24, 3\], got \[1, 72\]"):
        body.pose(torch.zeros(1, 72))
