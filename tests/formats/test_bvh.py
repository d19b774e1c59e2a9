"""BVH files: results computed by hand, unusual layouts, and a one-line error for each kind of damage."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from snarfcli.errors import UserError
from snarfcli.formats.bvh import read_bvh

ARM = """HIERARCHY
ROOT Hips
{
  OFFSET 1.0 2.0 3.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Arm
  {
    OFFSET 0.0 10.0 0.0
    CHANNELS 3 Yrotation Zrotation Xrotation
    JOINT Hand
    {
      OFFSET 5.0 0.0 0.0
      CHANNELS 2 Zrotation Xposition
      End Site
      {
        OFFSET 0.5 0.25 0.0
      }
    }
  }
  JOINT Leg
  {
    OFFSET 0.0 -8.0 1.0
    CHANNELS 0
  }
}
MOTION
Frames: 2
Frame Time: 0.008333
"""
FRAMES = "0 90 1.5 10 20 30 -40 50 60 70 6\n1 2 3 0 0 0 0 0 0 0 5\n"


def write(tmp_path, text, name="walk.bvh", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


def turn(axis, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(4)
    matrix[:3, :3] = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }[axis]
    return matrix


def shift(*offset):
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def test_joints_and_world_transforms_are_those_of_the_format(tmp_path):
    rig = read_bvh(write(tmp_path, ARM + FRAMES))
    assert rig.names == ("Hips", "Arm", "Hand", "Hand_end", "Leg")
    assert rig.parents == (-1, 0, 1, 2, 0)
    assert rig.mesh is None
    np.testing.assert_allclose(rig.rest[:, :3, 3], [[1, 2, 3], [1, 12, 3], [6, 12, 3], [6.5, 12.25, 3], [1, -6, 4]])
    np.testing.assert_array_equal(rig.rest[:, :3, :3], np.tile(np.eye(3), (5, 1, 1)))
    (clip,) = rig.clips
    assert clip.name == "walk"
    assert clip.frame_rate == 120.0
    assert clip.world_from_joint.shape == (2, 5, 4, 4)
    hips = shift(0, 90, 1.5) @ turn("z", 10) @ turn("x", 20) @ turn("y", 30)
    arm = hips @ shift(0, 10, 0) @ turn("y", -40) @ turn("z", 50) @ turn("x", 60)
    hand = arm @ shift(6, 0, 0) @ turn("z", 70)
    expected = [hips, arm, hand, hand @ shift(0.5, 0.25, 0), hips @ shift(0, -8, 1)]
    np.testing.assert_allclose(clip.world_from_joint[0], expected, atol=1e-12)
    # in the second frame nothing is turned, and the root stands where its channels say
    np.testing.assert_allclose(clip.world_from_joint[1, :, :3, 3], rig.rest[:, :3, 3] + [0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
def test_every_order_of_rotations(tmp_path, order):
    channels = " ".join(f"{axis}rotation" for axis in order)
    text = f"HIERARCHY ROOT a {{ OFFSET 0 0 0 CHANNELS 3 {channels} }}\nMOTION\nFrames: 1\nFrame Time: .5\n11 -22 133\n"
    world = read_bvh(write(tmp_path, text)).clips[0].world_from_joint[0, 0]
    first, second, third = (turn(axis.lower(), angle) for axis, angle in zip(order, (11, -22, 133), strict=True))
    np.testing.assert_allclose(world, first @ second @ third, atol=1e-14)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.lower(),
        lambda text: text.upper().replace("HIPS", "hips"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("  ", "\t").replace(" ", " \t "),
        lambda text: text.replace("\n", "\n\n"),
        lambda text: text.rstrip("\n"),
        lambda text: text.replace("\n  {", " {").replace("\n{", "{"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace(" 10.0 ", " 1.0e1 ").replace("90", "+9.0E+01"),
        lambda text: text.replace("Frames: 2", "Frames 2").replace("Frame Time:", "Frametime :"),
        lambda text: text.replace("Frames: 2", "Frames: 3"),
        lambda text: text.replace("Frames: 2", "Frames: 1"),
        lambda text: text + "0 90 1.5 10 20",
        lambda text: text.replace(" 30 -40", "\n30 -40"),
        lambda text: text + "\n \n\t\n",
    ],
    ids=[
        "lower", "upper", "crlf", "cr", "tabs", "blank_lines", "no_last_newline", "braces_on_the_line", "bom", "exponents",
        "colons", "too_few_frames", "too_many_frames", "incomplete_frame", "wrapped_frame", "blank_end",
    ],
)  # fmt: skip
def test_odd_layouts_are_the_same_motion(tmp_path, change):
    plain, odd = read_bvh(write(tmp_path, ARM + FRAMES)), read_bvh(write(tmp_path, change(ARM + FRAMES), "odd.bvh"))
    assert odd.parents == plain.parents
    assert [n.lower() for n in odd.names] == [n.lower() for n in plain.names]
    np.testing.assert_allclose(odd.rest, plain.rest)
    np.testing.assert_allclose(odd.clips[0].world_from_joint, plain.clips[0].world_from_joint, atol=1e-12)
    assert odd.clips[0].frame_rate == 120


def test_names_with_spaces_twice_and_none(tmp_path):
    joint = "JOINT {} {{ OFFSET 0 0 0\nCHANNELS 0\nEnd Site\n{{ OFFSET 0 0 1 }} }}\n"
    text = "HIERARCHY\nROOT mixamorig:Hips é\n{ OFFSET 0 0 0\nCHANNELS 1 Xrotation\n" + joint.format("Left Arm") * 2
    text += joint.format("") + "}\nMOTION\nFrames: 1\nFrame Time: 0.1\n0\n"
    assert read_bvh(write(tmp_path, text)).names == (
        "mixamorig:Hips é", "Left Arm", "Left Arm_end", "Left Arm_2", "Left Arm_end_2", "joint_5", "joint_5_end",
    )  # fmt: skip
    assert read_bvh(write(tmp_path, text, encoding="latin1")).names[0] == "mixamorig:Hips \ufffd"


def test_two_roots(tmp_path):
    root = "ROOT {} {{ OFFSET 1 0 0 CHANNELS 1 Zrotation JOINT b {{ OFFSET 1 0 0 CHANNELS 0 }} }}\n"
    text = "HIERARCHY\n" + root.format("a") + root.format("c") + "MOTION\nFrames: 1\nFrame Time: 1\n90 0\n"
    rig = read_bvh(write(tmp_path, text))
    assert rig.names == ("a", "b", "c", "b_2")
    assert rig.parents == (-1, 0, -1, 2)
    expected = [[1, 0, 0], [1, 1, 0], [1, 0, 0], [2, 0, 0]]
    np.testing.assert_allclose(rig.clips[0].world_from_joint[0, :, :3, 3], expected, atol=1e-15)


@pytest.mark.parametrize(
    ("seconds", "rate"), [("0", 60), ("0.0333333", 30), ("0.033367", 1 / 0.033367), ("0.5", 2), ("4", 0.25)]
)
def test_frame_times(tmp_path, seconds, rate):
    clip = read_bvh(write(tmp_path, ARM.replace("0.008333", seconds) + FRAMES)).clips[0]
    assert clip.frame_rate == pytest.approx(rate, rel=1e-9)


def test_what_is_odd_is_noted(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "snarfcli"):
        text = ARM.replace("Frames: 2", "Frames: 9").replace("Frame Time: 0.008333\n", "")
        read_bvh(write(tmp_path, text + FRAMES + "1 2 3"))
    assert "'9' frames are declared, 2 were found" in caplog.text
    assert "no frame time given, 60 frames per second assumed" in caplog.text
    assert "the last frame is incomplete and was left out" in caplog.text


_POSITIONED = """HIERARCHY
ROOT hips {{ OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT knee {{ OFFSET {knee} CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT foot {{ OFFSET {foot} CHANNELS 3 Xposition Yposition Zposition End Site {{ OFFSET 0 0 2 }} }} }} }}
MOTION
Frames: 3
Frame Time: 0.1
"""


def positioned(tmp_path, knee, foot, at_knee, at_foot):
    frames = "".join(f"5 {frame} 0 0 0 0 {at_knee} 90 0 0 {at_foot}\n" for frame in range(3))
    return read_bvh(write(tmp_path, _POSITIONED.format(knee=knee, foot=foot) + frames))


@pytest.mark.parametrize(
    ("knee", "foot"), [("0 -4 0", "0 -3 0"), ("0 0 0", "0 0 0"), ("0 -4 0", "0 0 0"), ("0 -0.04 0", "0 -0.03 0")]
)
def test_positions_tell_the_rest_pose_where_offsets_do_not(tmp_path, knee, foot):
    rig = positioned(tmp_path, knee, foot, "0 -4 0", "0 -3 0")
    np.testing.assert_allclose(rig.rest[:3, :3, 3], [[0, 0, 0], [0, -4, 0], [0, -7, 0]], atol=1e-12)
    # the knee is turned by 90 degrees about z, so the foot is beside it
    np.testing.assert_allclose(rig.clips[0].world_from_joint[1, :3, :3, 3], [[5, 1, 0], [5, -3, 0], [8, -3, 0]], atol=1e-12)


def test_hips_that_travel_below_a_root_keep_their_offset(tmp_path):
    """So two takes of one rig have the same rest pose."""
    text = """HIERARCHY
ROOT Reference {{ OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT Hips {{ OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT Leg {{ OFFSET 0 -40 0 CHANNELS 3 Zrotation Xrotation Yrotation
JOINT Foot {{ OFFSET 0 -40 0 CHANNELS 3 Zrotation Xrotation Yrotation End Site {{ OFFSET 0 0 9 }} }} }}
JOINT Spine {{ OFFSET 0 9 0 CHANNELS 0 }} }} }}
MOTION
Frames: 3
Frame Time: 0.1
"""
    for start, step in ((0, 3), (200, 3), (200, 0)):  # walking twice, and standing
        frames = "".join(f"0 0 0 0 0 0 {start + step * frame} 80 0 0 0 0 0 0 0 0 0 0\n" for frame in range(3))
        rig = read_bvh(write(tmp_path, text.format() + frames))
        np.testing.assert_array_equal(rig.rest[:4, :3, 3], [[0, 0, 0], [0, 0, 0], [0, -40, 0], [0, -80, 0]])
        assert rig.clips[0].world_from_joint[2, 1, 0, 3] == start + 2 * step


def test_offsets_without_positions_get_the_units_of_the_positions(tmp_path):
    text = """HIERARCHY
ROOT hips {{ OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT knee {{ OFFSET 0 -0.4 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT foot {{ OFFSET 0 -0.3 0 CHANNELS 3 Zrotation Xrotation Yrotation End Site {{ OFFSET 0 0 0.1 }} }} }} }}
MOTION
Frames: 2
Frame Time: 0.1
"""
    rig = read_bvh(write(tmp_path, text.format() + "0 0 0 0 0 0 0 -40 0 0 0 0 0 0 0\n" * 2))
    np.testing.assert_allclose(rig.rest[:, :3, 3], [[0, 0, 0], [0, -40, 0], [0, -70, 0], [0, -70, 10]], atol=1e-12)
    np.testing.assert_allclose(rig.clips[0].world_from_joint[1, :, :3, 3], rig.rest[:, :3, 3], atol=1e-12)


def test_positions_near_zero_are_added_to_the_offsets(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "snarfcli"):
        rig = positioned(tmp_path, "0 -4 0", "0 -3 0", "0 0.1 0", "0 0 0")
    assert "near zero and were added to their OFFSETs" in caplog.text
    np.testing.assert_allclose(rig.rest[:3, :3, 3], [[0, 0, 0], [0, -4, 0], [0, -7, 0]], atol=1e-12)
    np.testing.assert_allclose(rig.clips[0].world_from_joint[1, 1:3, :3, 3], [[5, -2.9, 0], [8, -2.9, 0]], atol=1e-12)


def test_joints_without_motion(tmp_path):
    assert read_bvh(write(tmp_path, ARM)).clips == ()
    assert read_bvh(write(tmp_path, ARM.split("MOTION")[0])).clips == ()


def test_deep_nesting_is_no_recursion(tmp_path):
    depth = 4000
    text = "HIERARCHY\nROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation\n"
    text += "JOINT b { OFFSET 0 1 0 CHANNELS 0\n" * (depth - 1) + "}" * depth + "\nMOTION\nFrames: 1\nFrame Time: 1\n90\n"
    rig = read_bvh(write(tmp_path, text))
    np.testing.assert_allclose(rig.clips[0].world_from_joint[0, -1, :3, 3], [0, 0, depth - 1], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 0: a BVH file begins with HIERARCHY"),
        ("\x00\x01binary", "line 1: a BVH file begins with HIERARCHY"),
        ("HIERARCHY\n", "line 1: there is no ROOT"),
        ("HIERARCHY\nJOINT a", "line 2: a ROOT must stand outside"),
        ("HIERARCHY\nROOT a", "line 2: the file ends after the name of a joint"),
        ("HIERARCHY\nROOT a\nOFFSET 0 0 0", "line 3: wanted { after the name of a joint, got 'OFFSET'"),
        ("HIERARCHY\nROOT a {\nOFFSET 0 0", "line 3: the file ends inside the hierarchy"),
        ("HIERARCHY\nROOT a {\nOFFSET 0 0 zero", "line 3: wanted a number, got 'zero'"),
        ("HIERARCHY\nROOT a {\nOFFSET 0 0 nan", "line 3: wanted a number, got 'nan'"),
        ("HIERARCHY\nROOT a {\nCHANNELS 3 Xrotation Yrotation Wrotation", "wanted a channel such as .*, got 'Wrotation'"),
        ("HIERARCHY\nROOT a {\nCHANNELS 2 Xrotation xRotation", "a channel is named twice"),
        ("HIERARCHY\nROOT a {\nCHANNELS 99999999999", "wanted 0 to 6 channels, got '99999999999'"),
        ("HIERARCHY\nROOT a {\nROOT b {", "line 3: a ROOT must stand outside"),
        ("HIERARCHY\nROOT a {\nEnd Site {\nJOINT b {", "line 4: an End Site cannot contain joints"),
        ("HIERARCHY\nROOT a {\nOFSET 0 0 0 }", "line 3: wanted OFFSET, CHANNELS, JOINT, End Site or a brace, got 'OFSET'"),
        ("HIERARCHY\nROOT a {\nOFFSET 0 0 0\nMOTION\n", "line 4: the braces of 1 joint are not closed"),
        ("HIERARCHY\nROOT a { }\n}\nMOTION\n", "line 3: wanted ROOT or MOTION, got '}'"),
        ("HIERARCHY\n" + "ROOT a { }\n" * 5001, "line 5002: there are more than 5000 joints"),
        (ARM + "0 90 1.5 10 20 30 -40 50 60 70 6 7\n", "line 29: frame 0: wanted 11 values, one per channel, got 12"),
        (ARM + "0 90 1.5 10 20 30 -40 50 60 70 nan\n", "line 29: frame 0 has NaN"),
        (ARM + "0 90 1,5 10 20 30 -40 50 60 70 6\n", "line 29: wanted a number, got '1,5'"),
        (ARM.replace("0.008333", "fast") + FRAMES, "line 28: wanted a number, got 'fast'"),
        (ARM.replace("0.008333", "-1") + FRAMES, "line 28: wanted a frame time in seconds, got '-1'"),
        (ARM.replace("10.0", "1e308").replace("5.0", "1e308") + "0 1e308 0 0 0 0 0 0 0 0 0\n", "numbers too large"),
        ("x" * 2**20, "line 1: the line is too long"),
    ],
)  # fmt: skip
def test_broken_files_end_in_one_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(UserError, match=message) as caught:
        read_bvh(path)
    assert str(caught.value).isprintable()
    assert str(path) in str(caught.value)


def test_missing_files(tmp_path):
    with pytest.raises(UserError, match="no BVH file at"):
        read_bvh(tmp_path / "none.bvh")
    with pytest.raises(UserError, match="is a folder"):
        read_bvh(tmp_path)


def test_few_channels_and_many_joints_take_no_memory(tmp_path):
    text = "HIERARCHY\n" + "ROOT a { OFFSET 0 0 0 CHANNELS 0 }\n" * 4999
    text += "ROOT b { CHANNELS 1 Xrotation }\nMOTION\nFrames: 1000000\nFrame Time: 1\n" + "0\n" * 1000
    with pytest.raises(UserError, match="wanted at most 419 frames of 5000 joints, got more; cut the file into parts"):
        read_bvh(write(tmp_path, text))
