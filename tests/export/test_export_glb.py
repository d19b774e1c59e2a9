"""`Avatar.export_glb` on an untrained avatar with networks, against `Avatar.mesh`."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from glb_reader import GlbReader
from toy_character import FRAME_RATE, ToyCharacter, stretched, wave
from toy_human import ToyHuman
from toy_training import avatar_config

from snarfcli.avatar import Avatar
from snarfcli.deformer import CanonicalGrid
from snarfcli.errors import UserError
from snarfcli.motions import builtin_motion

SMALL = {"triangles": None, "resolution": 32}


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    torch.manual_seed(0)
    skeleton, config = ToyCharacter().skeleton, avatar_config(capsules=True)
    surface = torch.cat([skeleton.canonical_joints + shift for shift in (torch.zeros(3), torch.tensor([0.2, 0.06, 0.0]))])
    grid = CanonicalGrid.around(surface, [0.15, 0.15, 0.15])
    avatar = Avatar(config, skeleton, grid, surface, {"data": "builtin", "subject": "toy"}).to("cpu")
    avatar.model.eval()
    return avatar


def test_the_file_shows_what_mesh_returns(avatar, tmp_path):
    motions = [wave(4), wave(3, "back", -0.6)]
    report = avatar.export_glb(tmp_path / "toy.glb", motions, **SMALL)
    reader = GlbReader(tmp_path / "toy.glb")
    assert report.num_bytes == (tmp_path / "toy.glb").stat().st_size
    assert reader.mesh.name == "toy"
    assert [clip.name for clip in report.clips] == ["wave", "back"]
    for motion in motions:
        for frame in range(motion.num_frames):
            pose, translation = (torch.from_numpy(part[frame]).float() for part in (motion.poses, motion.translation))
            wanted = avatar.mesh(pose, translation, resolution=32, surface="skinned").vertices
            error = np.linalg.norm(reader.vertices(motion.name, frame / FRAME_RATE) - wanted, axis=1).max()
            assert error < 5e-4 + 1e-3 * report.truncation_mm["max_mm"]


def test_joints_of_humans_can_be_renamed(avatar, tmp_path):
    few = {"resolution": 32, "triangles": 300, "morph_targets": 0}
    motion = builtin_motion("punching", 0, frame_rate=10).slice(stop=2)
    ToyHuman().export_glb(tmp_path / "a.glb", motion, names="unreal", **few)
    reader = GlbReader(tmp_path / "a.glb")
    assert reader.gltf.nodes[reader.skin.joints[1]].name == "thigh_l"
    with pytest.raises(UserError, match="names=vrm: wanted the skeleton of a human"):
        avatar.export_glb(tmp_path / "b.glb", wave(2), names="vrm", **few)


def test_one_motion_or_clip_will_do(avatar, tmp_path):
    few = {"resolution": 32, "triangles": 300, "morph_targets": 0, "influences": 8, "weight_colors": True}
    report = avatar.export_glb(tmp_path / "a.glb", wave(2), **few)
    assert report.triangles <= 300
    assert report.influences == 8
    assert report.morph_targets == 0
    again = avatar.export_glb(tmp_path / "b.glb", stretched(wave(2), ToyCharacter()), **few)
    assert again.clips[0].frames == 2
    with pytest.raises(UserError, match=r"a.glb exists already"):
        avatar.export_glb(tmp_path / "a.glb", wave(2), **few)
    with pytest.raises(ValueError, match="influences: wanted 4 or 8, got 5"):
        avatar.export_glb(tmp_path / "c.glb", wave(2), influences=5)
    with pytest.raises(ValueError, match="clips: wanted at least one motion to export"):
        avatar.export_glb(tmp_path / "c.glb", [])
