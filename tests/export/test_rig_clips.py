"""The motion of a file on the file's own skeleton, and as BVH."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_character import JOINTS, ToyCharacter, stretched, wave
from toy_rigs import a_pose, rig_of, write_bvh

from snarfcli.errors import UserError
from snarfcli.export.bvh import BvhOptions, export_bvh
from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.export import export_character
from snarfcli.export.rig_clips import rig_clip, up_axis_of
from snarfcli.formats.bvh import read_bvh
from snarfcli.formats.gltf import read_gltf
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.motions import builtin_motion

AS_READ = BvhOptions(units_per_metre=1, end_sites=False, root_offset=True)
TREE = """HIERARCHY
ROOT hip of all
{
  OFFSET 1.5 90.25 -3
  CHANNELS 6 Zposition Xposition Yposition Yrotation Zrotation Xrotation
  JOINT b
  {
    OFFSET 0 12.3456789 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT slides
    {
      OFFSET 1 2 3
      CHANNELS 6 Xposition Yposition Zposition Xrotation Yrotation Zrotation
      End Site
      {
        OFFSET 0 0 4
      }
      End Site
      {
        OFFSET 0 5 0
      }
    }
  }
  JOINT c_end
  {
    OFFSET -3 0 0
    CHANNELS 1 Xrotation
  }
}
MOTION
Frames: 3
Frame Time: 0.0083333
2 1 95 0 0 0 10 20 30 1 2 3 170 80 -20 5
3 1 96 10 -85 170 10 89.9 30 1 2 4 -170 80 -30 185
4 1 97 20 -95 190 10 91 30 9 2 3 -150 80 -40 365
"""


def round_trip(rig: Rig, folder: Path, options: BvhOptions = AS_READ) -> Rig:
    skeleton, clip = rig_clip(rig, rig.clips[0], "file")
    export_bvh(folder / "out.bvh", clip, skeleton, options)
    return read_bvh(folder / "out.bvh")


def check_same(found: Rig, rig: Rig, size: float) -> None:
    """Check that joints, rest positions, and motion relative to the rest pose agree."""
    columns = [found.names.index(name) for name in rig.names]
    parents = [found.names[found.parents[at]] if found.parents[at] >= 0 else None for at in columns]
    assert parents == [rig.names[parent] if parent >= 0 else None for parent in rig.parents]
    np.testing.assert_allclose(found.rest[columns, :3, 3], rig.rest[:, :3, 3], atol=1e-6 * size)
    moved = found.clips[0].world_from_joint[:, columns] @ np.linalg.inv(found.rest[columns])
    wanted = rig.clips[0].world_from_joint @ np.linalg.inv(rig.rest)
    np.testing.assert_allclose(moved[..., :3, :3], wanted[..., :3, :3], atol=1e-6)
    np.testing.assert_allclose(
        found.clips[0].world_from_joint[:, columns][..., :3, 3], rig.clips[0].world_from_joint[..., :3, 3], atol=1e-6 * size
    )


def test_a_bvh_file_stays_as_it_is(tmp_path):
    (tmp_path / "in.bvh").write_text(TREE)
    rig = read_bvh(tmp_path / "in.bvh")
    found = round_trip(rig, tmp_path)
    assert found.names == rig.names
    assert found.parents == rig.parents
    assert found.clips[0].frame_rate == rig.clips[0].frame_rate == 120
    check_same(found, rig, 100)
    text = (tmp_path / "out.bvh").read_text()
    assert text.count("End Site") == 2
    assert "OFFSET 0.000000 12.345679 0.000000" in text
    assert text.count("Xposition") == 2  # the root, and the joint that slides


@pytest.mark.parametrize("rest_pose", [None, a_pose()], ids=["t", "a"])
def test_motions_in_other_rest_poses_units_and_axes(tmp_path, rest_pose):
    motion = builtin_motion("lunges", 0, frame_rate=30).slice(stop=8)
    up = Rotation.from_euler("x", 90, degrees=True)
    rig = rig_of(motion.poses, motion.translation, rest_pose=rest_pose, world=up, scale=39.37)
    write_bvh(tmp_path / "in.bvh", rig, order="YXZ")
    rig = read_bvh(tmp_path / "in.bvh")
    check_same(round_trip(rig, tmp_path), rig, 40)
    skeleton, clip = rig_clip(rig, rig.clips[0], "file")
    assert up_axis_of(skeleton, clip) == "z"
    turned = round_trip(rig, tmp_path / "y", replace(AS_READ, skeleton_up="z", up="y"))
    assert up_axis_of(*rig_clip(turned, turned.clips[0], "file")) == "y"


def test_joints_that_are_turned_at_rest(tmp_path):
    """The joints of a glTF file have the axes of the canonical pose, which is bent."""
    toy = ToyCharacter()
    export_character(toy, tmp_path / "worm.glb", [Clip(wave(7))], CharacterOptions(triangles=300, resolution=32))
    rig = read_gltf(tmp_path / "worm.glb")
    assert np.abs(rig.rest[:, :3, :3] - np.eye(3)).max() > 0.2
    check_same(round_trip(rig, tmp_path), rig, 1)


def test_joints_that_stretch_and_grow(tmp_path):
    toy = ToyCharacter()
    clip = stretched(wave(5), toy, 1.3)
    export_character(toy, tmp_path / "worm.glb", [clip], CharacterOptions(triangles=300, resolution=32))
    rig = read_gltf(tmp_path / "worm.glb")
    found_skeleton, found_clip = rig_clip(rig, rig.clips[0], "worm.glb")
    assert found_clip.bone_transforms is not None
    report = export_bvh(tmp_path / "out.bvh", found_clip, found_skeleton)
    assert report.resized == ("bone_3", "bone_4", "bone_5")
    places = read_bvh(tmp_path / "out.bvh").clips[0].world_from_joint[:, :JOINTS, :3, 3]
    np.testing.assert_allclose(places / 100, rig.clips[0].world_from_joint[..., :3, 3], atol=1e-6)


def test_scale_that_does_not_change_is_none(tmp_path):
    """Many files have centimetres below a node that scales by 0.01, or mirrored joints."""
    toy = wave(4)
    character = ToyCharacter()
    export_character(character, tmp_path / "a.glb", [Clip(toy)], CharacterOptions(triangles=300, resolution=32))
    rig = read_gltf(tmp_path / "a.glb")
    sizes = np.diag([0.01, 0.01, -0.02, 1])
    clip = replace(rig.clips[0], world_from_joint=rig.clips[0].world_from_joint @ sizes)
    scaled = replace(rig, rest=rig.rest @ sizes, clips=(clip,))
    skeleton, found = rig_clip(scaled, clip, "a.glb")
    assert found.bone_transforms is None
    check_same(round_trip(scaled, tmp_path), rig, 1)
    assert skeleton.names == rig.names


def test_what_cannot_be_written():
    rest = np.tile(np.eye(4), (2, 1, 1))
    posed = np.tile(np.eye(4), (3, 2, 1, 1))
    rig = Rig(("a", "b"), (-1, 0), rest, ())
    with pytest.raises(UserError, match=re.escape("a.glb: clip 'go': wanted at least 1 frame, got 0")):
        rig_clip(rig, RigClip("go", 30.0, posed[:0]), "a.glb")
    flat = rest.copy()
    flat[1, 2, 2] = 0
    with pytest.raises(UserError, match=re.escape("a.glb: joint 'b' has scale 0 at rest")):
        rig_clip(replace(rig, rest=flat), RigClip("go", 30.0, posed), "a.glb")
    huge = posed.copy()
    huge[1, 1, 0, 3] = 1e200
    with pytest.raises(UserError, match=re.escape("a.glb: clip 'go' has numbers too large to add up")):
        rig_clip(rig, RigClip("go", 30.0, huge), "a.glb")
    skeleton, clip = rig_clip(rig, RigClip("go", 30.0, posed), "a.glb")
    assert up_axis_of(skeleton, clip) == "y"  # not human
