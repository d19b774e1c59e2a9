"""Pose codes of points: the operator against its reference."""

from __future__ import annotations

import pytest
import torch

from snarfcli.networks.pose_code import pose_code, pose_code_backward, pose_code_reference, run_pose_code


def made(count: int, poses: int, parts: int, size: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(count)
    seen = torch.rand(count, parts, generator=generator, dtype=dtype) * (torch.rand(count, parts, generator=generator) < 0.3)
    codes = torch.randn(poses, parts, size, generator=generator, dtype=dtype)
    return seen, codes, torch.randint(poses, (count,), generator=generator)


@pytest.mark.parametrize("shape", [(0, 2, 3, 4), (1, 1, 1, 1), (7, 3, 23, 16), (511, 4, 23, 8), (9001, 4, 5, 17)])
def test_native_codes_and_gradients_equal_the_reference(shape):
    seen, codes, pose = made(*shape)
    exact = codes.double().requires_grad_()
    wanted = pose_code_reference(seen.double(), exact, pose)
    given = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(1))
    v_codes = torch.autograd.grad(wanted, exact, given.double())[0]
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append((pose_code(seen, codes, pose), pose_code_backward(given, seen, pose, shape[1])))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
    torch.testing.assert_close(results[0][0].double(), wanted.detach(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(results[0][1].double(), v_codes, rtol=1e-4, atol=1e-4)


def test_gradients_are_those_of_finite_differences():
    seen, codes, pose = made(9, 2, 5, 3, torch.float64)
    assert torch.autograd.gradcheck(lambda given: pose_code(seen, given, pose), [codes.requires_grad_()])


def test_operator_contract():
    seen, codes, pose = made(9, 2, 5, 3)
    torch.library.opcheck(pose_code, (seen, codes.requires_grad_(), pose))
    gradient = torch.ones(9, 3)
    torch.library.opcheck(pose_code_backward, (gradient, seen, pose, 2), test_utils=("test_schema", "test_faketensor"))


def test_no_gradient_reaches_the_shares():
    seen, codes, pose = made(9, 2, 5, 3)
    run_pose_code(seen.requires_grad_(), codes.requires_grad_(), pose).sum().backward()
    assert seen.grad is None
    assert codes.grad is not None


def test_a_pose_that_does_not_exist_is_refused():
    seen, codes, pose = made(9, 2, 5, 3)
    with pytest.raises(RuntimeError, match="rejected its arguments"):
        pose_code(seen, codes, pose + 1)


def test_shapes_that_do_not_fit_are_refused():
    seen, codes, pose = made(9, 2, 5, 3)
    with pytest.raises(ValueError, match=r"codes: wanted shape \[B, 5, K\], got \[2, 4, 3\]"):
        pose_code(seen, codes[:, :4], pose)
    with pytest.raises(ValueError, match=r"pose: wanted int64 \[9\], got torch.int64 \[8\]"):
        pose_code(seen, codes, pose[:8])
    with pytest.raises(ValueError, match=r"pose: wanted int64 \[9\], got torch.int32 \[9\]"):
        pose_code(seen, codes, pose.int())
    with pytest.raises(ValueError, match=r"gradient: wanted shape \[9, K\], got \[8, 3\]"):
        pose_code_backward(torch.ones(8, 3), seen, pose, 2)
