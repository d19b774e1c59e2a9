"""What fits into a page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy_character import JOINTS, ToyCharacter, stretched, wave

from snarfcli.errors import UserError
from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.html_size import plan_page

ROOM = 3_000_000
HUMAN = 24


def clip(frames: int, rate: float = 60.0, joints: int = HUMAN) -> Clip:
    motion = wave(2)
    return Clip(replace(motion, poses=np.zeros((frames, joints, 3)), translation=np.zeros((frames, 3)), frame_rate=rate))


def test_a_usual_character_is_not_reduced():
    clips = [clip(600), clip(1200)]
    plan = plan_page(clips, CharacterOptions(), HUMAN, ROOM)
    assert plan.options == CharacterOptions()
    assert plan.clips == clips
    assert plan.frame_rate is None


def test_triangles_are_limited():
    plan = plan_page([clip(600)], CharacterOptions(triangles=None), HUMAN, ROOM)
    assert plan.options.triangles is not None
    assert 30_000 < plan.options.triangles < 60_000
    large = plan_page([clip(600)], CharacterOptions(triangles=5_000_000), HUMAN, ROOM)
    assert large.options.triangles == plan.options.triangles
    many = plan_page([clip(600)], CharacterOptions(triangles=None, morph_targets=64), HUMAN, ROOM)
    assert many.options.triangles is not None
    assert many.options.triangles < plan.options.triangles / 4


def test_of_long_motions_every_nth_frame_is_kept():
    long = clip(20_000)
    plan = plan_page([long], CharacterOptions(), HUMAN, ROOM)
    assert plan.frame_rate == plan.clips[0].motion.frame_rate == 60 / 3
    assert plan.clips[0].motion.num_frames == len(range(0, 20_000, 3))
    assert plan.options.triangles is not None
    assert plan.options.triangles > 10_000
    toy = ToyCharacter()
    waving = wave(9)
    thinned = plan_page([stretched(waving, toy)], CharacterOptions(morph_targets=0), JOINTS, 18_500).clips[0]
    assert thinned.bone_transforms is not None
    assert len(thinned.bone_transforms) == thinned.motion.num_frames < 9
    np.testing.assert_array_equal(thinned.motion.poses[1], waving.poses[round(24 / thinned.motion.frame_rate)])


def test_what_cannot_fit():
    with pytest.raises(
        UserError, match=r"format=html: wanted motions that fit into 5 MB, got 3333 s for 24 joints; give fewer"
    ):
        plan_page([clip(200_000)], CharacterOptions(), HUMAN, ROOM)
    with pytest.raises(UserError, match="format=html: morph_targets: wanted fewer, got 64"):
        plan_page([clip(100)], CharacterOptions(morph_targets=64), HUMAN, 80_000)
