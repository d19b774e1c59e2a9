"""Linear blend skinning of points, directions and normals against plain loops, and its inverse."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import random_transforms

from snarfcli.deformer import blended_matrices, inverse_skin, skin

BONES = 4


def inputs(batch=2, count=6, dtype=torch.float64, angle=0.5, seed=0):
    """Return points [B, N, 3], weights [B, N, J] and transforms [B, J, 4, 4] with scales and shears."""
    generator = torch.Generator().manual_seed(seed)
    canonical = torch.randn(batch, count, 3, generator=generator, dtype=torch.float64)
    weights = torch.softmax(2 * torch.randn(batch, count, BONES, generator=generator, dtype=torch.float64), -1)
    transforms = random_transforms(batch, BONES, angle, seed)
    transforms[..., :3, :3] += 0.1 * torch.randn(batch, BONES, 3, 3, generator=generator, dtype=torch.float64)
    return canonical.to(dtype), weights.to(dtype), transforms.to(dtype)


def unit_vectors(like, seed):
    vectors = torch.randn(like.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(vectors, dim=-1).to(like)


def by_loops(canonical, weights, transforms):
    """Return posed points [B, N, 3] and blended matrices [B, N, 4, 4], pose by pose, point by point and bone by bone."""
    posed, matrices = torch.zeros_like(canonical), torch.zeros(*canonical.shape[:2], 4, 4, dtype=canonical.dtype)
    for b in range(len(canonical)):
        for n in range(canonical.shape[1]):
            for j in range(transforms.shape[1]):
                matrices[b, n] += weights[b, n, j] * transforms[b, j]
            posed[b, n] = matrices[b, n, :3, :3] @ canonical[b, n] + matrices[b, n, :3, 3]
    return posed, matrices


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 2e-6)])  # 4 bones, 3 m
def test_points_and_matrices_are_those_of_a_loop(dtype, tolerance):
    canonical, weights, transforms = inputs(dtype=dtype)
    posed, matrices = by_loops(*inputs())
    torch.testing.assert_close(skin(canonical, weights, transforms), posed.to(dtype), atol=tolerance, rtol=0)
    blended = blended_matrices(weights, transforms)
    torch.testing.assert_close(blended, matrices.to(dtype), atol=tolerance, rtol=0)
    assert blended.dtype == dtype
    torch.testing.assert_close(blended[..., 3, :], torch.tensor([0.0, 0, 0, 1], dtype=dtype).expand(2, 6, 4), atol=1e-6, rtol=0)


def test_leading_dimensions_are_broadcast():
    canonical, weights, transforms = inputs(3)
    directions, normals = unit_vectors(canonical, 1), unit_vectors(canonical, 2)
    together = skin(canonical, weights[0], transforms, directions=directions, normals=normals)
    for b in range(3):
        alone = skin(canonical[b], weights[0], transforms[b], directions=directions[b], normals=normals[b])
        for one, all_of_them in zip(alone, together, strict=True):
            torch.testing.assert_close(all_of_them[b], one)
    shared = skin(canonical[0], weights[0], transforms)
    torch.testing.assert_close(shared[2], skin(canonical[0], weights[0], transforms[2]))
    one_pose = skin(canonical, weights, transforms[0])
    torch.testing.assert_close(one_pose[1], skin(canonical[1], weights[1], transforms[0]))
    assert blended_matrices(weights[0], transforms).shape == (3, 6, 4, 4)
    many = skin(canonical[:, None], weights[:, None], transforms[:, None].expand(3, 5, BONES, 4, 4))
    assert many.shape == (3, 5, 6, 3)
    assert torch.equal(many[:, 4], many[:, 0])


def test_what_is_returned_is_what_was_asked_for():
    canonical, weights, transforms = inputs()
    vectors = unit_vectors(canonical, 1)
    posed = skin(canonical, weights, transforms)
    assert isinstance(posed, torch.Tensor)
    both = skin(canonical, weights, transforms, directions=vectors, normals=vectors)
    (also_posed, moved), (_, turned) = (skin(canonical, weights, transforms, **{k: vectors}) for k in ("directions", "normals"))
    for one, other in zip(both, (posed, moved, turned), strict=True):
        assert torch.equal(one, other)
    assert torch.equal(also_posed, posed)


def test_directions_move_like_differences_of_points():
    canonical, weights, transforms = inputs()
    directions = unit_vectors(canonical, 1)
    posed, moved = skin(canonical, weights, transforms, directions=directions)
    ahead = skin(canonical + directions, weights, transforms)
    torch.testing.assert_close(moved, ahead - posed, atol=1e-13, rtol=0)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
def test_normals_stay_orthogonal_to_directions_and_on_their_side(mirrored, scale):
    canonical, weights, transforms = inputs(dtype=torch.float32)
    transforms[..., :3, :] *= scale
    if mirrored:
        transforms[..., 0, :3] *= -1
    normals = unit_vectors(canonical, 1)
    tangents = torch.linalg.cross(normals, unit_vectors(canonical, 2))
    outward = normals + 0.3 * tangents
    _, tangents, turned = skin(canonical, weights, transforms, directions=tangents, normals=normals)
    _, outward = skin(canonical, weights, transforms, directions=outward)
    torch.testing.assert_close(turned.norm(dim=-1), torch.ones(2, 6), atol=1e-6, rtol=0)
    assert float((turned * tangents).sum(-1).abs().max()) < 1e-6 * scale
    assert bool(((turned * outward).sum(-1) > 0).all())


def test_a_normal_under_a_rotation_and_a_scale_is_rotated():
    canonical, weights, _ = inputs()
    turned = random_transforms(2, 1, 0.8)
    transforms = turned.repeat(1, BONES, 1, 1)
    transforms[..., :3, :3] *= 1.7
    normals = unit_vectors(canonical, 1)
    _, moved = skin(canonical, weights, transforms, normals=normals)
    torch.testing.assert_close(moved, normals @ turned[:, 0, :3, :3].mT, atol=1e-14, rtol=0)
    _, none = skin(canonical, weights, transforms, normals=torch.zeros_like(normals))
    assert not none.any()


@pytest.mark.parametrize("kind", ["plain", "mirrored", "millimetres"])
def test_the_inverse_undoes_skinning(kind):
    canonical, weights, transforms = inputs()
    if kind == "mirrored":
        transforms[..., :3, 1] *= -1
    if kind == "millimetres":
        transforms[..., :3, :] *= 1000
    posed = skin(canonical, weights, transforms)
    torch.testing.assert_close(inverse_skin(posed, weights, transforms), canonical, atol=1e-11, rtol=0)
    shared = inverse_skin(skin(canonical, weights[0], transforms), weights[0], transforms)
    torch.testing.assert_close(shared, canonical, atol=1e-11, rtol=0)


def test_a_blend_without_inverse_sends_points_away():
    transforms = torch.eye(4).repeat(1, 2, 1, 1)
    transforms[0, 1, :2, :2] *= -1  # by half a turn about z
    point, weights = torch.tensor([[[0.3, 0.2, 0.1]]]), torch.tensor([[[0.5, 0.5]]])
    assert not inverse_skin(point, weights, transforms).isfinite().any()
    assert bool(inverse_skin(point, weights, transforms, least_determinant=0.01).isfinite().all())


def test_gradients():
    canonical, weights, transforms = inputs(count=3)
    vectors = unit_vectors(canonical, 1)
    arguments = [value.requires_grad_() for value in (canonical, weights, transforms, vectors)]

    def everything(canonical, weights, transforms, vectors):
        return skin(canonical, weights, transforms, directions=vectors, normals=vectors)

    assert torch.autograd.gradcheck(everything, arguments)
    assert torch.autograd.gradgradcheck(everything, arguments)
    shared = [canonical, weights[0].detach().requires_grad_(), transforms]
    for function in (inverse_skin, skin):
        assert torch.autograd.gradcheck(function, arguments[:3])
        assert torch.autograd.gradcheck(function, shared)
    assert torch.autograd.gradcheck(blended_matrices, arguments[1:3])


@pytest.mark.parametrize(("batch", "count"), [(0, 3), (2, 0), (0, 0)])
def test_nothing_to_move(batch, count):
    canonical, weights, transforms = inputs(batch, count)
    posed, moved, turned = skin(canonical, weights, transforms, directions=canonical, normals=canonical)
    assert posed.shape == moved.shape == turned.shape == (batch, count, 3)
    assert inverse_skin(canonical, weights, transforms).shape == (batch, count, 3)
    assert blended_matrices(weights, transforms).shape == (batch, count, 4, 4)


@pytest.mark.parametrize("precision", ["highest", "medium"])
def test_autocast_and_reduced_precision_change_nothing(precision):
    canonical, weights, transforms = inputs(2, 50, torch.float32)
    vectors = unit_vectors(canonical, 1)

    def everything():
        moved = skin(canonical, weights, transforms, directions=vectors, normals=vectors)
        return *moved, inverse_skin(moved[0], weights, transforms), blended_matrices(weights, transforms)

    plain, before = everything(), torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        with torch.autocast("cpu", torch.bfloat16):
            mixed = everything()
        assert torch.get_float32_matmul_precision() == precision
    finally:
        torch.set_float32_matmul_precision(before)
    for one, other in zip(plain, mixed, strict=True):
        assert torch.equal(one, other)


def test_it_compiles_and_maps():
    canonical, weights, transforms = inputs()
    normals = unit_vectors(canonical, 1)

    def everything(canonical, weights, transforms, normals):
        posed, turned = skin(canonical, weights, transforms, normals=normals)
        return posed, turned, inverse_skin(posed, weights, transforms)

    wanted = everything(canonical, weights, transforms, normals)
    compiled = torch.compile(everything, fullgraph=True, backend="aot_eager")(canonical, weights, transforms, normals)
    mapped = torch.vmap(everything)(canonical, weights, transforms, normals)
    for results in (compiled, mapped):
        for one, other in zip(results, wanted, strict=True):
            torch.testing.assert_close(one, other)


WRONG = {
    "points": ({"canonical": torch.zeros(2, 5, 4)}, ValueError, r"canonical: wanted shape \[..., N, 3\], got \[2, 5, 4\]"),
    "one point": ({"canonical": torch.zeros(3)}, ValueError, r"canonical: wanted shape \[..., N, 3\], got \[3\]"),
    "weights": (
        {"weights": torch.zeros(2, 4, 24)},
        ValueError,
        r"weights: wanted shape \[..., 5, J\] and at least one bone, got \[2, 4, 24\]",
    ),
    "no bones": ({"weights": torch.zeros(2, 5, 0)}, ValueError, r"weights: wanted .* at least one bone, got \[2, 5, 0\]"),
    "batch of weights": (
        {"weights": torch.zeros(3, 5, 24)},
        ValueError,
        r"weights: wanted shape \[2, 5, 24\] to fit the others, got \[3, 5, 24\]",
    ),
    "bones": (
        {"bone_transforms": torch.zeros(2, 23, 4, 4)},
        ValueError,
        r"bone_transforms: wanted shape \[2, 24, 4, 4\] to fit the others, got \[2, 23, 4, 4\]",
    ),
    "rows": (
        {"bone_transforms": torch.zeros(2, 24, 12)},
        ValueError,
        r"bone_transforms: wanted shape \[2, 24, 4, 4\] to fit the others, got \[2, 24, 12\]",
    ),
    "batch": (
        {"bone_transforms": torch.zeros(3, 24, 4, 4)},
        ValueError,
        r"bone_transforms: wanted shape \[2, 24, 4, 4\] to fit the others, got \[3, 24, 4, 4\]",
    ),
    "normals": (
        {"normals": torch.zeros(2, 6, 3)},
        ValueError,
        r"normals: wanted shape \[2, 5, 3\] to fit the others, got \[2, 6, 3\]",
    ),
    "integers": ({"canonical": torch.zeros(2, 5, 3, dtype=torch.long)}, TypeError, "canonical: wanted float32 or float64"),
    "half": ({"weights": torch.zeros(2, 5, 24).half()}, TypeError, "weights: wanted float32 or float64, got torch.float16"),
    "mixed": ({"directions": torch.zeros(2, 5, 3).double()}, TypeError, "directions: wanted the dtype of canonical"),
    "device": ({"weights": torch.zeros(2, 5, 24, device="meta")}, ValueError, "weights: wanted the device of canonical, cpu"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments_are_named(case):
    good = {
        "canonical": torch.zeros(2, 5, 3),
        "weights": torch.zeros(2, 5, 24),
        "bone_transforms": torch.eye(4).repeat(2, 24, 1, 1),
    }
    change, error, message = WRONG[case]
    with pytest.raises(error, match=message) as caught:
        skin(**good | change)
    assert "\n" not in str(caught.value)


def test_wrong_arguments_of_the_others_are_named():
    with pytest.raises(ValueError, match=r"posed: wanted shape \[..., N, 3\], got \[5, 2\]"):
        inverse_skin(torch.zeros(5, 2), torch.zeros(5, 3), torch.zeros(3, 4, 4))
    with pytest.raises(ValueError, match=r"weights: wanted shape \[..., N, J\], got \[5\]"):
        blended_matrices(torch.zeros(5), torch.zeros(3, 4, 4))
    with pytest.raises(ValueError, match=r"bone_transforms: wanted shape \[3, 4, 4\] to fit the others, got \[2, 4, 4\]"):
        blended_matrices(torch.zeros(5, 3), torch.zeros(2, 4, 4))
