"""The released search as CUDA kernels, compiled as C++, beside the same search in PyTorch."""

from __future__ import annotations

import pytest
import torch
from cuda_emulation import host_compiler
from released_kernels import SOURCE, released_search_native
from released_search import DUPLICATE_M, released_search
from skinning_scenes import posed_queries, random_transforms, smooth_weights, unit_grid

from snarfcli.deformer.skinning import blend_transforms
from snarfcli.deformer.starts import start_transforms
from snarfcli.native import cuda_compile

SHAPE = (6, 7, 8)
BONES = [0, 2, 3, 5]


def nvrtc_is_missing() -> bool:
    try:
        cuda_compile.nvrtc_version()
    except RuntimeError:
        return True
    return False


def both(dtype, steps, angle=0.5):
    """Return the roots in PyTorch, and those of the kernels as a list, of queries on the body, beside it and far away."""
    grid, weights = unit_grid(dtype), smooth_weights(SHAPE, 6, dtype=dtype)
    poses = random_transforms(2, 6, angle, dtype=dtype)
    points = torch.stack([posed_queries(weights, pose, 300, seed)[0] for seed, pose in enumerate(poses)])
    points[:, ::10] *= 3
    points[0, 0] = torch.nan
    wanted = released_search(points, poses, weights, grid, BONES, steps)
    starts = start_transforms(poses, BONES)
    found = released_search_native(points, blend_transforms(weights, poses), starts, grid, SHAPE, steps)
    query = torch.arange(600).reshape(2, 300, 1).expand_as(found.valid)[found.valid]
    return wanted, (found.canonical[found.valid], query, found.jacobian_inverse[found.valid]), found


@pytest.mark.skipif(host_compiler() is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("steps", [10, 50])
def test_kernels_find_the_roots_of_the_version_in_pytorch(steps):
    wanted, found, padded = both(torch.float64, steps)
    assert len(found[1]) > 500
    assert torch.equal(found[1], wanted[1])
    torch.testing.assert_close(found[0], wanted[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(found[2], wanted[2], rtol=1e-6, atol=1e-6)
    assert not padded.valid[0, 0].any()  # the query that is not a number
    several = (padded.valid.sum(-1) > 1).nonzero()
    assert len(several) > 10
    for pose, n in several.tolist():
        roots = padded.canonical[pose, n][padded.valid[pose, n]]
        assert torch.pdist(roots).min() >= DUPLICATE_M


@pytest.mark.skipif(host_compiler() is None, reason="needs a C++ compiler")
def test_kernels_in_float32_find_the_same_but_for_rounding():
    wanted, found, _ = both(torch.float32, 10)
    # A step more or less where rounding decides whether 0.1 mm is reached: the roots then differ by about that much.
    mine, theirs = (torch.bincount(query, minlength=600) for query in (found[1], wanted[1]))
    same = mine == theirs
    assert float(same.float().mean()) > 0.99
    off = (found[0][same[found[1]]] - wanted[0][same[wanted[1]]]).norm(dim=1)
    assert float((off < 1e-5).float().mean()) > 0.99
    assert off.max() < 1e-3


@pytest.mark.skipif(host_compiler() is None, reason="needs a C++ compiler")
def test_no_query_and_no_start_are_no_root():
    grid, weights, poses = unit_grid(), smooth_weights(SHAPE, 6), random_transforms(2, 6, 0.5)
    nodes, starts = blend_transforms(weights, poses), start_transforms(poses, BONES)
    assert released_search_native(torch.zeros(2, 0, 3).double(), nodes, starts, grid, SHAPE).valid.shape == (2, 0, 4)
    assert released_search_native(torch.zeros(2, 5, 3).double(), nodes, starts[:, :0], grid, SHAPE).valid.shape == (2, 5, 0)


@pytest.mark.skipif(nvrtc_is_missing(), reason="needs NVRTC")
@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_120"])
def test_nvrtc_compiles_the_kernels(architecture):
    for dtype in (torch.float32, torch.float64):
        code = cuda_compile.compile_kernels(SOURCE, dtype, architecture)
        assert all(f".text.{kernel}".encode() in code for kernel in ("search_from_bones", "filter_duplicates"))


@pytest.mark.skipif(nvrtc_is_missing(), reason="needs NVRTC")
def test_kernels_from_a_path_are_kept_under_their_name_and_content(tmp_path, monkeypatch):
    monkeypatch.setattr(cuda_compile, "cache_folder", lambda: tmp_path / "cuda")
    source = tmp_path / "mine.cu"
    source.write_text(SOURCE.read_text())
    code = cuda_compile.load_kernels(source, torch.float32, "sm_80")
    source.write_text(SOURCE.read_text().replace("search_from_bones", "renamed"))
    assert b".text.renamed" in cuda_compile.load_kernels(source, torch.float32, "sm_80")
    assert len(list((tmp_path / "cuda").glob("mine-float-sm_80-*.bin"))) == 2
    assert b".text.search_from_bones" in code
