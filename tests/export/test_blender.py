"""What Blender makes of exported files, and of those that it wrote itself; skipped without `bpy` or `blender`."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from glb_reader import SCRIPTS
from toy_character import FRAME_RATE, JOINTS, ToyCharacter, stretched, wave

from snarfcli.errors import UserError
from snarfcli.export.blender import convert, find_blender
from snarfcli.export.bvh import export_bvh
from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip, clip_transforms
from snarfcli.export.export import export_character

try:
    BLENDER = find_blender()
except UserError:
    BLENDER = []
needs_blender = pytest.mark.skipif(not BLENDER, reason="wants Blender: pip install bpy, or blender on the PATH")

OPTIONS = CharacterOptions(triangles=None, resolution=40)
FRAMES = (0, 5, 12)


def look(path: Path, clip: Clip) -> dict:
    """Return what Blender reads from a file."""
    command = [*BLENDER, str(SCRIPTS / "blender_vertices.py"), "--", str(path), repr(clip.motion.frame_rate), clip.motion.name]
    done = subprocess.run([*command, *map(str, FRAMES)], capture_output=True, text=True, timeout=300)
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("BLENDER ")] or [done.stdout + done.stderr]
    return json.loads(line.removeprefix("BLENDER "))


@needs_blender
@pytest.mark.parametrize("suffix", ["glb", "fbx", "usd"])
def test_blender_gives_the_skinned_surface(tmp_path, suffix):
    toy = ToyCharacter()
    clips = [Clip(wave())] if suffix == "usd" else [Clip(wave()), Clip(wave(20, "back", -0.5))]
    path = tmp_path / "worm.glb"
    report = export_character(toy, path, clips, OPTIONS)
    if suffix != "glb":
        path = tmp_path / f"worm.{suffix}"
        assert convert(BLENDER, tmp_path / "worm.glb", path, clips[0].motion.frame_rate) == path.stat().st_size
    surface = toy.skinned_surface(OPTIONS.resolution)
    for clip in clips:
        found = look(path, clip)
        assert found["smooth"]
        assert found["bones"] == [f"bone_{joint}" for joint in range(JOINTS)]
        assert len(found["shape_keys"]) == report.morph_targets or suffix == "usd"
        last = {end for name, (_, end) in found["clips"].items() if suffix == "usd" or name.split("|")[-1] == clip.motion.name}
        assert last == {clip.motion.num_frames - 1}
        for frame, vertices in zip(FRAMES, found["frames"], strict=True):
            pose, translation = (torch.from_numpy(part[frame]).float() for part in (clip.motion.poses, clip.motion.translation))
            error = np.linalg.norm(np.array(vertices) - surface.posed(pose, translation).vertices, axis=1).max()
            assert error < 5e-4 + 1e-3 * report.truncation_mm["max_mm"]


@needs_blender
@pytest.mark.parametrize("scale", [None, 1.0])  # without and with position channels
def test_blender_reads_bvh(tmp_path, scale):
    toy = ToyCharacter()
    clip = Clip(wave()) if scale is None else stretched(wave(), toy, scale)
    export_bvh(tmp_path / "worm.bvh", clip, toy.skeleton)
    command = [*BLENDER, str(SCRIPTS / "blender_bvh.py"), "--", str(tmp_path / "worm.bvh"), repr(FRAME_RATE), *map(str, FRAMES)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("BLENDER ")] or [done.stdout + done.stderr]
    transforms = clip_transforms(toy.skeleton, clip)
    joints = toy.skeleton.canonical_joints.numpy()
    for frame, heads in zip(FRAMES, json.loads(line.removeprefix("BLENDER "))["frames"], strict=True):
        wanted = np.einsum("jab,jb->ja", transforms[frame, :, :3, :3], joints) + transforms[frame, :, :3, 3]
        np.testing.assert_allclose([heads[name] for name in toy.skeleton.names], wanted, atol=1e-4)  # float32 in Blender


@needs_blender
def test_a_file_that_blender_cannot_read_is_a_line(tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"glTF and then nothing")
    with pytest.raises(UserError, match=r"Blender could not write bad.fbx"):
        convert(BLENDER, tmp_path / "bad.glb", tmp_path / "bad.fbx", 30.0)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.glb"]
