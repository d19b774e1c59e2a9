"""Linear blend skinning in NumPy, against the sum written out vertex by vertex."""

from __future__ import annotations

import numpy as np
import pytest

from snarfcli.bodies.skinning import blend_transforms, skin_vertices, transform_points

VERTICES, BONES = 7, 3


def scene(*leading, dtype=np.float64):
    random = np.random.default_rng(0)
    transforms = random.normal(size=(*leading, BONES, 4, 4))
    transforms[..., 3, :] = (0, 0, 0, 1)
    weights = random.dirichlet(np.ones(BONES), VERTICES)
    return (array.astype(dtype) for array in (random.normal(size=(VERTICES, 3)), weights, transforms))


@pytest.mark.parametrize("leading", [(), (0,), (1,), (2, 3)], ids=str)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-6), (np.float64, 1e-14)])  # a few roundings of numbers near 1
def test_skinning_is_the_weighted_sum_over_bones(leading, dtype, tolerance):
    vertices, weights, transforms = scene(*leading, dtype=dtype)
    posed = skin_vertices(vertices, weights, transforms)
    assert posed.dtype == dtype
    assert posed.shape == (*leading, VERTICES, 3)
    for index in np.ndindex(*leading):
        for vertex in range(VERTICES):
            moved = [bone @ np.append(vertices[vertex], 1) for bone in transforms[index].astype(np.float64)]
            wanted = sum(weight * one for weight, one in zip(weights[vertex], moved, strict=True))[:3]
            np.testing.assert_allclose(posed[(*index, vertex)], wanted, rtol=0, atol=10 * tolerance)


def test_one_weight_moves_rigidly_and_keeps_the_precise_type():
    vertices, _, transforms = scene()
    weights = np.zeros((VERTICES, BONES), np.float32)
    weights[:, 1] = 1
    posed = skin_vertices(vertices.astype(np.float32), weights, transforms)
    assert posed.dtype == np.float64
    wanted = vertices.astype(np.float32) @ transforms[1, :3, :3].T + transforms[1, :3, 3]
    np.testing.assert_allclose(posed, wanted, rtol=0, atol=1e-14)


def test_blending_keeps_the_rows_that_it_gets():
    _, weights, transforms = scene(2)
    whole = blend_transforms(weights, transforms)
    assert whole.shape == (2, VERTICES, 4, 4)
    np.testing.assert_allclose(whole[..., 3, :], np.broadcast_to((0, 0, 0, 1), (2, VERTICES, 4)), atol=1e-15)
    np.testing.assert_allclose(blend_transforms(weights, transforms[..., :3, :]), whole[..., :3, :], atol=1e-15)


def test_a_fourth_row_is_ignored():
    vertices, weights, transforms = scene()
    blended = blend_transforms(weights, transforms)
    np.testing.assert_array_equal(transform_points(blended, vertices), transform_points(blended[:, :3], vertices))
