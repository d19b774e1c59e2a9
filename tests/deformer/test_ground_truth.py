"""The exhaustive search itself: against answers by hand, against many starts of Newton's method, and by counting signs."""

from __future__ import annotations

import numpy as np
import pytest
from ground_truth import blended_nodes, field, locate_cells, true_roots
from scipy.spatial.transform import Rotation

LOWER, UPPER = np.array([-1.0, -0.9, -1.1]), np.array([1.0, 1.1, 0.9])


def rigid(generator, bones, angle, shift=0.1):
    """Return random rigid transforms [J, 4, 4]."""
    transforms = np.tile(np.eye(4), (bones, 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(generator.normal(0, angle, (bones, 3))).as_matrix()
    transforms[:, :3, 3] = generator.normal(0, shift, (bones, 3))
    return transforms


def random_field(generator, shape, bones, sharpness=3.0):
    """Return weights [D, H, W, J] without any smoothness."""
    logits = sharpness * generator.normal(size=(*shape, bones))
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def nodes_of(shape):
    """Return the nodes [D, H, W, 3]."""
    axes = [np.linspace(LOWER[2 - k], UPPER[2 - k], shape[k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij")[::-1], -1)


def residuals(truth, points, weights, transforms):
    shape = weights.shape[:3]
    cell, local = locate_cells(truth.canonical, shape, LOWER, UPPER)
    posed, _ = field(blended_nodes(weights, transforms), shape, LOWER, UPPER, cell, local)
    return np.linalg.norm(posed - points[truth.query], axis=1)


def test_rigid_motion_has_one_root_and_it_is_the_inverse():
    generator = np.random.default_rng(0)
    transforms = rigid(generator, 1, 1.0)
    weights = np.ones((4, 5, 6, 1))
    canonical = LOWER + generator.random((500, 3)) * (UPPER - LOWER)
    points = canonical @ transforms[0, :3, :3].T + transforms[0, :3, 3]
    truth = true_roots(points, weights, transforms, LOWER, UPPER)
    assert truth.query.tolist() == list(range(500))
    np.testing.assert_allclose(truth.canonical, canonical, atol=1e-12)
    np.testing.assert_allclose(truth.jacobian_inverse, np.tile(transforms[0, :3, :3].T, (500, 1, 1)), atol=1e-12)
    assert not truth.seam.any()


def test_roots_on_faces_edges_and_nodes_come_once():
    generator = np.random.default_rng(1)
    transforms = rigid(generator, 1, 1.0)
    nodes = nodes_of((4, 5, 6))[1:-1, 1:-1, 1:-1].reshape(-1, 3)
    mid_edges = nodes + np.array([0.2, 0, 0])
    canonical = np.concatenate([nodes, mid_edges, mid_edges + np.array([0, 0.25, 0])])
    points = canonical @ transforms[0, :3, :3].T + transforms[0, :3, 3]
    truth = true_roots(points, np.ones((4, 5, 6, 1)), transforms, LOWER, UPPER)
    assert truth.query.tolist() == list(range(len(points)))
    assert not truth.seam.any()


def test_border_of_the_cells_is_a_seam():
    points = np.zeros((6, 3))
    points[:, 0] = UPPER[0] - 1e-10, UPPER[0] + 1e-10, 0.3, 9, np.nan, np.inf
    active = np.ones((2, 2, 2), bool)
    truth = true_roots(points, np.ones((3, 3, 3, 1)), np.eye(4)[None], LOWER, UPPER, active_cells=active)
    assert truth.seam.tolist() == [True, True, False, False, False, False]
    active[:, :, 1] = False
    points = np.array([[-1e-10, 0, 0], [1e-10, 0, 0], [0.3, 0, 0], [-0.3, 0, 0]])
    truth = true_roots(points, np.ones((3, 3, 3, 1)), np.eye(4)[None], LOWER, UPPER, active_cells=active)
    assert truth.seam.tolist() == [True, True, False, False]
    assert 3 in truth.query
    assert 2 not in truth.query


@pytest.mark.parametrize("angle", [1.5, 2.5, 3.1])
def test_turning_by_one_coordinate_is_a_cubic(angle):
    """A rotation about z blended in along x: eliminating y leaves a cubic in x for every column of cells.

    With s the weight of the turned bone, a = 1 + s (cos - 1) and b = s sin, d = (a x - b y, b x + a y, z), so
    x (a^2 + b^2) = a x' + b y' and y (a^2 + b^2) = a y' - b x'.
    """
    generator = np.random.default_rng(2)
    shape, knots = (3, 4, 7), np.linspace(LOWER[0], UPPER[0], 7)
    share = generator.random(7)  # up and down, so that there are many roots
    weights = np.zeros((*shape, 2))
    weights[..., 1] = share
    weights[..., 0] = 1 - share
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[1, :3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    points = np.concatenate([generator.uniform(-0.5, 0.5, (400, 2)), generator.uniform(LOWER[2], UPPER[2], (400, 1))], 1)
    truth = true_roots(points, weights, transforms, LOWER, UPPER, seam=1e-7)
    total = several = 0
    for q in (~truth.seam).nonzero()[0]:
        x_p, y_p, z = points[q]
        wanted = []
        for k in range(6):
            slope = (share[k + 1] - share[k]) / (knots[k + 1] - knots[k])
            s = np.poly1d([slope, share[k] - slope * knots[k]])
            a, b = 1 + s * (np.cos(angle) - 1), s * np.sin(angle)
            for x in (np.poly1d([1, 0]) * (a * a + b * b) - a * x_p - b * y_p).roots:
                x, norm = x.real if abs(x.imag) < 1e-9 else np.nan, a(x.real) ** 2 + b(x.real) ** 2
                y = (a(x) * y_p - b(x) * x_p) / norm
                if knots[k] <= x <= knots[k + 1] and LOWER[1] <= y <= UPPER[1]:
                    wanted.append([x, y, z])
        found = truth.of(q)
        assert len(found) == len(wanted), f"query {q}"
        if wanted:
            order = [np.argsort(np.array(roots)[:, 0]) for roots in (wanted, found)]
            np.testing.assert_allclose(found[order[1]], np.array(wanted)[order[0]], atol=1e-7)
        total, several = total + len(wanted), several + (len(wanted) > 1)
    assert total > 300
    assert several > 20
    assert (truth.determinant < 0).sum() > 20
    assert truth.seam.mean() < 0.01


@pytest.mark.parametrize(("bones", "angle", "seed"), [(2, 1.5, 0), (5, 0.6, 1), (24, 0.8, 2), (55, 0.8, 3)])
def test_signs_of_the_roots_add_up_to_one_when_the_border_stays_put(bones, angle, seed):
    """The degree of a map that is the identity on the border is one: roots that keep orientation minus those that do not."""
    generator = np.random.default_rng(seed)
    shape = (6, 7, 8)
    weights = random_field(generator, shape, bones)
    border = np.ones(shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    weights[border] = np.eye(bones)[0]
    transforms = rigid(generator, bones, angle)
    transforms[0] = np.eye(4)
    points = LOWER + generator.random((3000, 3)) * (UPPER - LOWER)
    truth = true_roots(points, weights, transforms, LOWER, UPPER, seam=1e-8)
    degree = np.bincount(truth.query, np.sign(truth.determinant), minlength=len(points))
    assert (degree[~truth.seam] == 1).all()
    assert truth.seam.mean() < 0.01
    assert len(truth.query) > 1.15 * len(points)  # folded indeed
    assert truth.folded_cells > 10
    assert residuals(truth, points, weights, transforms).max() < 1e-10


@pytest.mark.parametrize(("bones", "angle", "seed"), [(6, 1.5, 4), (24, 0.9, 5)])
def test_many_starts_of_newton_find_the_same(bones, angle, seed):
    generator = np.random.default_rng(seed)
    shape, starts = (4, 5, 4), 4
    weights, transforms = random_field(generator, shape, bones, 8.0), rigid(generator, bones, angle)
    points = generator.uniform(-0.6, 0.6, (40, 3))
    truth = true_roots(points, weights, transforms, LOWER, UPPER, seam=1e-7)
    nodes, total = blended_nodes(weights, transforms), (3 * 4 * 3)
    inner = (np.arange(starts) + 0.5) / starts
    first = np.stack(np.meshgrid(inner, inner, inner), -1).reshape(-1, 3)
    cell = np.repeat(np.arange(total), len(first))
    size = (UPPER - LOWER) / (np.array(shape[::-1]) - 1)
    for q in (~truth.seam).nonzero()[0]:
        local = np.tile(first, (total, 1))
        for _ in range(25):
            posed, jacobian = field(nodes, shape, LOWER, UPPER, cell, local)
            step = np.linalg.solve(jacobian, (posed - points[q])[:, :, None])[:, :, 0] / size
            local = local - step / np.maximum(1, np.abs(step).max(1, keepdims=True) / 0.3)
        posed, _ = field(nodes, shape, LOWER, UPPER, cell, local)
        good = (np.linalg.norm(posed - points[q], axis=1) < 1e-10) & ((local >= 0) & (local <= 1)).all(1)
        index = np.stack([cell % 3, cell // 3 % 4, cell // 12], 1)
        found = np.unique(np.round(LOWER + (index + local)[good] * size, 7), axis=0)
        merged = [x for i, x in enumerate(found) if not (np.linalg.norm(found[:i] - x, axis=1) < 1e-6).any()]
        roots = truth.of(q)
        assert len(merged) == len(roots), f"query {q}: {merged} and {roots}"
        for x in merged:
            assert np.linalg.norm(roots - x, axis=1).min() < 1e-6
    assert len(truth.query) > 50


def test_jacobian_inverse_is_the_one_of_differences():
    generator = np.random.default_rng(6)
    weights, transforms = random_field(generator, (4, 5, 4), 6), rigid(generator, 6, 0.6)
    points = generator.uniform(-0.5, 0.5, (200, 3))
    truth = true_roots(points, weights, transforms, LOWER, UPPER)
    nodes, shape, h = blended_nodes(weights, transforms), (4, 5, 4), 1e-6
    size = (UPPER - LOWER) / (np.array(shape[::-1]) - 1)
    cell, local = locate_cells(truth.canonical, shape, LOWER, UPPER)
    assert (cell == truth.cell).mean() > 0.99
    inner = (np.abs(local - 0.5) < 0.499).all(1)
    columns = []
    for axis in range(3):
        step = np.eye(3)[axis] * h / size
        ahead, behind = (field(nodes, shape, LOWER, UPPER, cell, local + sign * step)[0] for sign in (1, -1))
        columns.append((ahead - behind) / (2 * h))
    jacobian = np.stack(columns, 2)
    np.testing.assert_allclose((jacobian @ truth.jacobian_inverse)[inner], np.tile(np.eye(3), (inner.sum(), 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(jacobian)[inner], truth.determinant[inner], atol=1e-6)


def test_queries_beside_a_fold_are_on_a_seam():
    """A unit cell from identity to a reflection of x: d_x = x (1 - 2 x), which is largest, 1/8, at x = 1/4."""
    weights = np.zeros((2, 2, 2, 2))
    weights[:, :, 0, 0] = 1.0
    weights[:, :, 1, 1] = 1.0
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[1, 0, 0] = -1.0
    lower, upper = np.zeros(3), np.ones(3)
    at = 0.125 + np.array([-1e-3, -1e-9, 1e-9, 1e-3])
    points = np.stack([at, np.full(4, 0.4), np.full(4, 0.6)], 1)
    truth = true_roots(points, weights, transforms, lower, upper, seam=1e-8)
    assert truth.seam.tolist() == [False, True, True, False]
    assert len(truth.of(0)) == 2
    assert len(truth.of(3)) == 0
    x = 0.25 + np.array([-1, 1]) * np.sqrt(1e-3 / 2)
    np.testing.assert_allclose(np.sort(truth.of(0)[:, 0]), x, atol=1e-12)


def test_a_fold_on_a_face_is_a_seam():
    """Two cells, the second turned over: what the first covers, the second covers again."""
    weights = np.zeros((2, 2, 3, 2))
    weights[..., :2, 0] = 1.0
    weights[..., 2, 1] = 1.0
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[1, 0, 3] = -1.0  # x = 1 goes to 0, and x = 1/2 stays where it is
    points = np.stack([0.5 + np.array([-0.2, -1e-9, 1e-9, 0.2]), np.full(4, 0.4), np.full(4, 0.6)], 1)
    truth = true_roots(points, weights, transforms, np.zeros(3), np.ones(3), seam=1e-8)
    assert truth.seam.tolist() == [False, True, True, False]
    assert len(truth.of(0)) == 2
    assert len(truth.of(3)) == 0


def test_nothing_to_search():
    arguments = np.ones((3, 3, 3, 1)), np.eye(4)[None], LOWER, UPPER
    assert len(true_roots(np.zeros((0, 3)), *arguments).query) == 0
    truth = true_roots(np.zeros((4, 3)), *arguments, active_cells=np.zeros((2, 2, 2), bool))
    assert len(truth.query) == 0
    assert truth.seam.tolist() == [False] * 4
