"""Clips placed on the ground."""

from __future__ import annotations

import numpy as np
import pytest
from toy_character import ToyCharacter, wave

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.export.clips import Clip, clip_transforms, lowest_point, on_ground

TOY = ToyCharacter()
MESH = TOY.skinned_surface(32).mesh


@pytest.mark.parametrize("stretches", [False, True])
def test_the_lowest_point_of_the_clip_stands_on_zero(stretches):
    clip = Clip(wave())
    if stretches:
        clip = Clip(clip.motion, clip_transforms(TOY.skeleton, clip).astype(np.float32))
    before = clip_transforms(TOY.skeleton, clip).copy()
    moved, up = on_ground(MESH, TOY.skeleton, clip)
    after = clip_transforms(TOY.skeleton, moved)
    heights = [skin_vertices(MESH.vertices, MESH.weights, one)[:, 1].min() for one in after]
    assert min(heights) == pytest.approx(0, abs=1e-6)
    assert max(heights) > 0.01
    difference = after - before
    np.testing.assert_allclose(difference[:, :, 1, 3], up, atol=1e-6)  # the whole clip by as much, and nothing else
    difference[:, :, 1, 3] = 0
    np.testing.assert_allclose(difference, 0, atol=1e-6)
    assert lowest_point(MESH, TOY.skeleton, moved) == pytest.approx(0, abs=1e-6)
    np.testing.assert_array_equal(clip_transforms(TOY.skeleton, clip), before)  # what was given stays
