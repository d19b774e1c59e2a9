"""Try an installed wheel: its native library is active, and finds the correspondences that the reference in PyTorch finds."""

from __future__ import annotations

import sys

import torch
from snarf.native.library import instruction_set, library_path, why_unavailable

import snarf
from snarf.deformer import CanonicalGrid, SearchConfig, find_correspondences


def main() -> int:
    """Return 0, or 1 if the native library is not used or finds other roots."""
    reason = why_unavailable()
    if reason is not None:
        print(f"the native library is not available: {reason}", file=sys.stderr)
        return 1
    generator = torch.Generator().manual_seed(0)
    body = snarf.builtin_body()
    grid = CanonicalGrid.around(body.v_template, (0.4, 0.2, 0.2))
    weights = torch.softmax(torch.randn(5, 9, 9, body.num_joints, generator=generator), dim=-1)
    skeleton = body.skeleton()
    pose = skeleton.canonical_pose + 0.1 * torch.randn(skeleton.canonical_pose.shape, generator=generator)
    transforms = skeleton.posed_from_canonical(pose[None])
    points = body.v_template[None, ::50]
    native, reference = (
        find_correspondences(points, transforms, weights, grid, search=SearchConfig(backend=backend))
        for backend in ("native", "reference")
    )
    same = torch.equal(native.query, reference.query)
    same = same and torch.allclose(native.canonical, reference.canonical, atol=1e-4)
    print(f"snarf {snarf.__version__}, {instruction_set()}, {library_path()}: {len(native.query)} roots")
    if not (same and len(native.query)):
        print(f"the native search differs from the reference, which found {len(reference.query)} roots", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
