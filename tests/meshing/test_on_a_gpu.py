"""Meshes on the pretend GPU: the same as on the CPU, without mixing of devices, and with few waits for the device."""

from __future__ import annotations

import re

import pytest

run_on_pretend_gpu = pytest.importorskip("pretend_gpu.run", reason="there is no pretend GPU").run_on_pretend_gpu

EXTRACTION = """
import numpy as np
import torch
from pretend_gpu.device import CUDA, watch
from snarfcli.meshing.extract import EmptySurface, FullSurface, extract_surface

def balls(points):
    large, small = 0.6 - points.norm(dim=1), 0.1 - (points - 0.62).norm(dim=1)
    return torch.maximum(large, small)

BOX = ([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
CASES = {
    "plain": dict(field=balls, resolution=64),
    "a part is dropped": dict(field=balls, resolution=64, keep_share=0.2),
    "chunks, layers and refinement": dict(field=balls, resolution=48, coarse=12, chunk=1000, dilate=2, refine=3),
    "infinite": dict(field=lambda points: torch.where(balls(points) > 0, torch.inf, -torch.inf), resolution=32),
    "capped": dict(field=balls, upper=[0.3, 1.0, 1.0], resolution=32),
    "widened": dict(field=balls, upper=[0.3, 1.0, 1.0], resolution=32, widen=True),
}
extract_surface(balls, *BOX, 16, device=CUDA)  # copies the tables
for name, case in CASES.items():
    case = dict(lower=BOX[0], upper=BOX[1]) | case
    wanted = extract_surface(**case)
    with watch(name) as seen:
        found = extract_surface(**case, device=CUDA)
    for array in ("vertices", "faces", "normals"):
        np.testing.assert_array_equal(getattr(found, array), getattr(wanted, array))
    facts = ("points", "components", "kept", "capped")
    assert [getattr(found.stats, fact) for fact in facts] == [getattr(wanted.stats, fact) for fact in facts]
for error, value in ((EmptySurface, -1.0), (FullSurface, 1.0), (ValueError, torch.nan)):
    try:
        extract_surface(lambda points: torch.full_like(points[:, 0], value), *BOX, 16, device=CUDA)
    except error as found:
        assert value == value or "got NaN at" in str(found)
    else:
        raise AssertionError(error)
"""

AVATAR = """
import numpy as np
import torch
from pretend_gpu.device import CUDA, watch
from snarfcli.meshing.surfaces import field_surface
from tiny_avatars import tiny_avatar

avatars = [tiny_avatar("local").to(device) for device in ("cpu", CUDA)]
pose, shift = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.0, 0.4], [0.0, 0.3, 0.0]]), torch.tensor([0.1, -2.0, 0.3])
wanted, found = (field_surface(avatar, pose, shift, 48) for avatar in avatars)
np.testing.assert_array_equal(found.faces, wanted.faces)
np.testing.assert_allclose(found.vertices, wanted.vertices, atol=1e-5)
wanted, found = (avatar.skinned_surface(48) for avatar in avatars)
with watch("field"):
    field_surface(avatars[1], pose, shift, 48)
with watch("skinned"):
    found = found.posed(pose, shift)
wanted = wanted.posed(pose, shift)
np.testing.assert_array_equal(found.faces, wanted.faces)
np.testing.assert_allclose(found.vertices, wanted.vertices, atol=1e-5)
np.testing.assert_allclose(found.normals, wanted.normals, atol=1e-3)
"""


def test_extraction_is_the_same_and_all_on_the_device():
    report = run_on_pretend_gpu(EXTRACTION)
    for seen in report.seen:
        assert seen.mixing == []
        assert seen.copies == []
    plain, dropped = report["plain"], report["a part is dropped"]
    # Two looks at flags; for the only level that is split a list of nodes and the end; three lists of marching cubes; the end
    # of connecting and the number of surfaces; vertices, faces and normals.
    assert len(plain.waits) == 12
    assert len(dropped.waits) == 14
    arrays = [what for what in plain.waits if re.match(r"copy (float32|int32)\[\d+, 3\] to the CPU", what)]
    assert len(arrays) == 3
    assert plain.kernels < 800


def test_surfaces_of_an_avatar_are_posed_on_the_device():
    report = run_on_pretend_gpu(AVATAR)
    for seen in report.seen:
        assert seen.mixing == []
        copies = [what.split(": ")[1] for what in seen.copies]
        from_here = [line for line in copies if line.startswith("snarfcli/meshing")]
        assert len(from_here) == 1  # the pose
    posed = [what for what in report["skinned"].waits if "meshing" in what.split(" < ")[0]]
    steps = sum("nearest_ways" in what for what in posed)
    assert 1 <= steps <= 8
    assert len(posed) == steps + 3  # whether points are lost, vertices and normals
