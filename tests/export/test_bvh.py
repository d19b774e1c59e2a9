"""BVH files of motions, as three readers see them: ours, pybvh and three.js."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from glb_reader import needs_readers, run_reader
from toy_character import ToyCharacter, stretched, wave

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.export.bvh import BvhOptions, export_bvh
from snarfcli.export.clips import Clip, clip_transforms
from snarfcli.formats.bvh import read_bvh
from snarfcli.formats.rig import Rig
from snarfcli.motions import Motion, builtin_motion, read_motion
from snarfcli.motions.reader import average_skeleton

SKELETON = average_skeleton()
FRAME_RATE = 25.0
MOTION = builtin_motion("high_kicks", 3, frame_rate=FRAME_RATE).slice(stop=60)
TO_CM = 100


def world(skeleton: Skeleton, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations [T, J, 3, 3] relative to the rest pose and positions [T, J, 3], metres."""
    skeleton = skeleton.to(torch.float64)
    canonical = skeleton.posed_from_rest(skeleton.canonical_pose[None])[0].numpy()
    moved = clip_transforms(skeleton, clip) @ canonical
    places = np.einsum("tjab,jb->tja", moved[..., :3, :3], skeleton.joints_rest.numpy()) + moved[..., :3, 3]
    return moved[..., :3, :3], places


def read(path: Path, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, Rig]:
    """Return rotations and positions of joints in a file."""
    rig = read_bvh(path)
    posed = rig.clips[0].world_from_joint[:, [rig.names.index(name) for name in names]]
    return posed[..., :3, :3], posed[..., :3, 3], rig


def degrees_apart(a: np.ndarray, b: np.ndarray) -> float:
    traces = np.einsum("...ab,...ab->...", a, b)
    return float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))).max())


def test_the_motion_comes_back(tmp_path):
    report = export_bvh(tmp_path / "kick.bvh", MOTION, SKELETON)
    assert (report.frames, report.joints, report.sliding, report.resized) == (60, 24, (), ())
    assert report.num_bytes == report.path.stat().st_size
    assert "kick.bvh: 24 joints, 60 frames, 2.36 s at 25 per second" in report.lines()[0]
    rotations, places = world(SKELETON, Clip(MOTION))
    found_rotations, found_places, rig = read(report.path, SKELETON.names)
    assert degrees_apart(found_rotations, rotations) < 1e-4
    np.testing.assert_allclose(found_places / TO_CM, places, atol=1e-7)
    assert rig.clips[0].frame_rate == FRAME_RATE
    back = read_motion(report.path, SKELETON)
    np.testing.assert_allclose(back.poses, MOTION.poses, atol=1e-6)
    np.testing.assert_allclose(back.translation, MOTION.translation, atol=1e-7)


def test_pybvh_agrees(tmp_path):
    pybvh = pytest.importorskip("pybvh", reason="an independent reader of BVH")
    export_bvh(tmp_path / "kick.bvh", MOTION, SKELETON)
    file = pybvh.read_bvh_file(str(tmp_path / "kick.bvh"))
    found = file.node_positions()[:, [[node.name for node in file.nodes].index(name) for name in SKELETON.names]]
    np.testing.assert_allclose(found / TO_CM, world(SKELETON, Clip(MOTION))[1], atol=1e-6)
    assert file.frame_time == pytest.approx(1 / FRAME_RATE, abs=1e-9)


@needs_readers
def test_three_js_agrees(tmp_path):
    export_bvh(tmp_path / "kick.bvh", MOTION, SKELETON)
    frames = (0, 7, 30)
    found = run_reader("bvh.mjs", tmp_path / "kick.bvh", *(frame / FRAME_RATE for frame in frames))
    bones = [found["bones"].index(name) for name in SKELETON.names]
    places = world(SKELETON, Clip(MOTION))[1]
    for frame, positions in zip(frames, found["frames"], strict=True):
        np.testing.assert_allclose(np.array(positions)[bones] / TO_CM, places[frame], atol=1e-6)
    assert found["duration"] == pytest.approx(59 / FRAME_RATE, abs=1e-6)


def test_the_canonical_pose_does_not_matter(tmp_path):
    turned = replace(SKELETON, canonical_pose=SKELETON.canonical_pose * 2 + 0.1)
    export_bvh(tmp_path / "a.bvh", MOTION, SKELETON)
    export_bvh(tmp_path / "b.bvh", MOTION, turned)
    np.testing.assert_allclose(
        read(tmp_path / "a.bvh", SKELETON.names)[1], read(tmp_path / "b.bvh", SKELETON.names)[1], atol=1e-5
    )


def test_units_axes_and_order(tmp_path):
    options = BvhOptions(units_per_metre=1000, up="z", order="YXZ")
    export_bvh(tmp_path / "a.bvh", MOTION, SKELETON, options)
    text = (tmp_path / "a.bvh").read_text()
    assert set(re.findall(r"(\wrotation) (\wrotation) (\wrotation)", text)) == {("Yrotation", "Xrotation", "Zrotation")}
    _, places, rig = read(tmp_path / "a.bvh", SKELETON.names)
    x, y, z = np.moveaxis(world(SKELETON, Clip(MOTION))[1], -1, 0)
    np.testing.assert_allclose(places / 1000, np.stack([x, -z, y], -1), atol=1e-6)
    head, pelvis = (rig.rest[rig.names.index(name), :3, 3] for name in ("head", "pelvis"))
    assert np.argmax(np.abs(head - pelvis)) == 2
    np.testing.assert_allclose(read_motion(tmp_path / "a.bvh", SKELETON, up="z").poses, MOTION.poses, atol=1e-6)


def test_joints_that_come_apart_have_position_channels(tmp_path, caplog):
    toy = ToyCharacter()
    clip = stretched(wave(5), toy)
    with caplog.at_level(logging.INFO):
        report = export_bvh(tmp_path / "worm.bvh", clip, toy.skeleton)
    assert report.sliding == ("bone_3",)
    assert report.resized == ()
    assert "joints that move relative to their parents have position channels: bone_3" in caplog.text
    rotations, places = world(toy.skeleton, clip)
    found_rotations, found_places, _ = read(report.path, toy.skeleton.names)
    np.testing.assert_allclose(found_places / TO_CM, places, atol=1e-6)
    assert degrees_apart(found_rotations, rotations) < 1e-4


def test_scale_is_left_out_and_said(tmp_path, caplog):
    toy = ToyCharacter()
    clip = stretched(wave(5), toy, 1.3)
    report = export_bvh(tmp_path / "worm.bvh", clip, toy.skeleton)
    assert report.resized == ("bone_3", "bone_4", "bone_5")
    assert "BVH has no scale; that of bone_3, bone_4, bone_5 was left out, positions are kept" in caplog.text
    rotations, places = world(toy.skeleton, clip)
    found_rotations, found_places, _ = read(report.path, toy.skeleton.names)
    np.testing.assert_allclose(found_places / TO_CM, places, atol=1e-6)
    sizes = np.linalg.norm(rotations, axis=-2, keepdims=True)
    assert degrees_apart(found_rotations, rotations / sizes) < 1e-4


def test_end_sites_continue_the_bones(tmp_path):
    export_bvh(tmp_path / "a.bvh", MOTION, SKELETON)
    rig = read_bvh(tmp_path / "a.bvh")
    ends = {name: rig.rest[at, :3, 3] - rig.rest[rig.parents[at], :3, 3] for at, name in enumerate(rig.names) if "_end" in name}
    assert sorted(ends) == ["head_end", "l_foot_end", "l_hand_end", "r_foot_end", "r_hand_end"]
    np.testing.assert_allclose(ends["l_hand_end"], [10, 0, 0], atol=1e-6)
    assert ends["l_foot_end"][1] == 0  # level, not into the floor
    assert ends["l_foot_end"][2] > 10
    export_bvh(tmp_path / "b.bvh", MOTION, SKELETON, BvhOptions(end_sites=False))
    assert read_bvh(tmp_path / "b.bvh").names == tuple(name for name in rig.names if "_end" not in name)


def test_names_that_would_break_the_file_are_mended(tmp_path):
    rest = torch.zeros(5, 3)
    rest[:, 1] = torch.arange(5)
    names = ("Bip01  Pelvis", "a{b}", "a b", "line\nbreak", " ")
    skeleton = Skeleton(names, (-1, 0, 1, 2, 3), rest, torch.zeros(5, 3))
    motion = Motion("still", np.zeros((1, 5, 3)), np.zeros((1, 3)), 30.0)
    export_bvh(tmp_path / "a.bvh", motion, skeleton, BvhOptions(end_sites=False))
    assert read_bvh(tmp_path / "a.bvh").names == ("Bip01 Pelvis", "a b", "a b_2", "line break", "joint_4")


def test_several_roots_and_a_single_joint(tmp_path):
    rest = torch.tensor([[0.0, 1, 0], [2, 0, 0], [2, 1, 0]])
    skeleton = Skeleton(("one", "two", "three"), (-1, -1, 1), rest, torch.zeros(3, 3))
    poses = np.random.default_rng(0).normal(size=(4, 3, 3))
    motion = Motion("two", poses, np.arange(12.0).reshape(4, 3), 30.0)
    export_bvh(tmp_path / "a.bvh", motion, skeleton)
    np.testing.assert_allclose(read(tmp_path / "a.bvh", skeleton.names)[1] / TO_CM, world(skeleton, Clip(motion))[1], atol=1e-6)
    alone = Skeleton(("one",), (-1,), rest[:1], torch.zeros(1, 3))
    export_bvh(tmp_path / "b.bvh", Motion("one", poses[:, :1], motion.translation, 30.0), alone)
    assert read_bvh(tmp_path / "b.bvh").names == ("one", "one_end")


def test_what_can_be_wrong(tmp_path):
    path = tmp_path / "a.bvh"
    for options, message in (
        (BvhOptions(order="XYX"), "order: wanted auto, ZXY, ZYX, XYZ, XZY, YXZ or YZX, got 'XYX'"),
        (BvhOptions(up="x"), "up: wanted y or z, got 'x'"),
        (BvhOptions(units_per_metre=0), "units_per_metre: wanted a positive number, got 0"),
    ):
        with pytest.raises(UserError, match=re.escape(message)):
            export_bvh(path, MOTION, SKELETON, options)
    with pytest.raises(ValueError, match="pose: wanted shape"):
        export_bvh(path, wave(2), SKELETON)
    assert not path.exists()
    path.write_text("mine")
    with pytest.raises(UserError, match=r"a.bvh exists already; give overwrite=true"):
        export_bvh(path, MOTION, SKELETON)
    export_bvh(path, MOTION, SKELETON, overwrite=True)
    assert path.read_text().startswith("HIERARCHY\nROOT pelvis\n")
