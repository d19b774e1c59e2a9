"""`snarf export format=bvh` end to end."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_character import ToyCharacter, wave
from toy_human import ToyHuman
from toy_rigs import MIXAMO_NAMES, rig_of, write_bvh

from snarfcli.cli.main import main
from snarfcli.commands import selection
from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.export import export_character
from snarfcli.formats.bvh import read_bvh
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.reader import average_skeleton


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """An empty current folder, without a trained avatar."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def human(folder, monkeypatch) -> ToyHuman:
    """An avatar where that of subject 50002 is looked for."""
    avatar = ToyHuman()
    avatar.facts = {"subject": "50002"}
    monkeypatch.setattr(selection.Avatar, "load", classmethod(lambda cls, path, device: avatar))
    run = folder / "outputs" / "builtin" / "50002" / "fast_snarf"
    run.mkdir(parents=True)
    (run / "avatar.pt").write_bytes(b"the toy")
    return avatar


def export(capsys, *arguments: str) -> tuple[int, str]:
    code = main(["export", "format=bvh", "device=cpu", "resolution=32", *arguments])
    return code, capsys.readouterr().err


def dance(frames: int = 6) -> Path:
    """Write a motion in inches under Mixamo's names."""
    motion = builtin_motion("lunges", 0, frame_rate=30).slice(stop=frames)
    rig = rig_of(motion.poses, motion.translation, MIXAMO_NAMES, scale=39.37)
    return write_bvh(Path("dance.bvh"), rig)


def test_motions_of_the_avatar(human, capsys):
    code, err = export(capsys, "--pose", str(dance()), "height=file")
    assert (code, err) == (0, "")
    path = Path("outputs/builtin/50002/fast_snarf/export/50002.bvh")
    wanted = read_motion("dance.bvh", human.skeleton)
    found = read_motion(path, human.skeleton)
    np.testing.assert_allclose(found.poses, wanted.poses, atol=1e-6)
    np.testing.assert_allclose(found.translation, wanted.translation, atol=1e-6)
    rig = read_bvh(path)
    height = np.ptp(rig.rest[:, 1, 3])
    assert 150 < height < 155  # centimetres, from the toes to the head
    record = json.loads(path.with_name(f"{path.stem}_bvh.json").read_text())
    assert record["files"][0]["frames"] == 6
    assert record["config"]["bvh"] == {"units": "auto", "up": "auto", "order": "auto"}


def test_built_in_motions_stand_on_the_ground_and_have_a_file_each(human, capsys):
    arguments = ("motion=[punching,lunges]", "max_frames=3", "output=me.bvh", "names=unreal", "bvh.units=m", "bvh.order=XYZ")
    code, err = export(capsys, *arguments)
    assert (code, err) == (0, "")
    assert sorted(path.name for path in Path().glob("me*")) == ["me_bvh.json", "me_lunges.bvh", "me_punching.bvh"]
    rig = read_bvh("me_punching.bvh")
    assert rig.names[0] == "pelvis"
    assert "lowerarm_l" in rig.names
    lowest = rig.clips[0].world_from_joint[:, rig.names.index("ball_l"), 1, 3].min()
    assert 0 <= lowest < 0.1
    assert set(re.findall(r"CHANNELS 3 (.*)", Path("me_lunges.bvh").read_text())) == {"Xrotation Yrotation Zrotation"}
    code, err = export(capsys, *arguments)
    assert code == 2
    assert "me_bvh.json exists already; give overwrite=true" in err
    assert export(capsys, *arguments, "overwrite=true")[0] == 0


def test_the_skeleton_of_a_file_needs_no_avatar(capsys):
    path = dance()
    code, err = export(capsys, "skeleton=file", "--pose", str(path), "start=1", "stop=5", "step=2")
    assert (code, err) == (0, "")
    found, rig = read_bvh("outputs/export/dance.bvh"), read_bvh(path)
    assert found.names == rig.names
    np.testing.assert_allclose(found.rest, rig.rest, atol=1e-5)
    np.testing.assert_allclose(found.clips[0].world_from_joint, rig.clips[0].world_from_joint[1:5:2], atol=1e-5)
    assert found.clips[0].frame_rate == 15


def test_files_without_skeleton_get_that_of_an_adult(capsys, caplog):
    motion = builtin_motion("lunges", 0, frame_rate=30).slice(stop=4)
    np.savez("walk.npz", poses=motion.poses.reshape(4, -1), trans=motion.translation, mocap_framerate=30.0)
    assert export(capsys, "skeleton=file", "--pose", "walk.npz", "up=y", "names=mixamo", "output=a.bvh")[0] == 0
    assert "walk.npz: the skeleton of an average adult is written" in caplog.text
    np.testing.assert_allclose(read_motion("a.bvh", average_skeleton()).poses, motion.poses, atol=1e-6)
    assert export(capsys, "skeleton=file", "motion=[punching]", "frame_rate=60", "max_frames=5", "bvh.up=z")[0] == 0
    rig = read_bvh("outputs/export/punching.bvh")
    assert (len(rig.clips[0].world_from_joint), rig.clips[0].frame_rate) == (5, 60)
    assert rig.rest[rig.names.index("head"), 2, 3] > 40


def test_the_person_of_a_pose_file_is_chosen(capsys):
    persons = {name: {"poses": np.zeros((frames, 72))} for name, frames in (("anna", 4), ("ben", 9))}
    Path("two.pkl").write_bytes(pickle.dumps(persons))
    assert export(capsys, "skeleton=file", "--pose", "two.pkl", "clip=ben", "output=a.bvh")[0] == 0
    assert len(read_bvh("a.bvh").clips[0].world_from_joint) == 9
    code, err = export(capsys, "skeleton=file", "--pose", "two.pkl", "mapping=none.json", "output=b.bvh")
    assert code == 2
    assert "mapping: wanted" in err
    code, err = export(capsys, "skeleton=file", "--pose", "a.bvh", "up=x", "output=b.bvh")
    assert code == 2
    assert "up: wanted auto, y, z with skeleton=file" in err


def test_a_clip_of_a_gltf_file(capsys):
    toy = ToyCharacter()
    clips = [Clip(wave(5)), Clip(wave(7, "back", -0.5))]
    export_character(toy, Path("worm.glb"), clips, CharacterOptions(triangles=300, resolution=32))
    code, err = export(capsys, "skeleton=file", "--pose", "worm.glb", "clip=back", "in_place=true", "bvh.units=mm")
    assert (code, err) == (0, "")
    rig = read_bvh("outputs/export/worm_back.bvh")
    assert rig.names[:-1] == toy.skeleton.names
    assert rig.names[-1] == f"{toy.skeleton.names[-1]}_end"
    way = rig.clips[0].world_from_joint[:, 0, :3, 3]
    assert len(way) == 7
    assert np.ptp(way[:, [0, 2]], axis=0).max() < 1e-3 < np.ptp(way[:, 1])
    assert np.linalg.norm(rig.rest[1, :3, 3] - rig.rest[0, :3, 3]) == pytest.approx(200, abs=1e-3)


def test_the_axes_of_a_file_are_guessed_if_they_matter(capsys, caplog):
    motion = builtin_motion("lunges", 0, frame_rate=30).slice(stop=4)
    write_bvh(Path("z.bvh"), rig_of(motion.poses, motion.translation, world=Rotation.from_euler("x", 90, degrees=True)))
    with caplog.at_level("INFO"):
        assert export(capsys, "skeleton=file", "--pose", "z.bvh", "bvh.up=y", "output=y.bvh")[0] == 0
    assert "z.bvh: z is taken as up in this file; give up=y or up=z for the other" in caplog.text
    np.testing.assert_allclose(read_motion("y.bvh", average_skeleton(), up="y").poses, motion.poses, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["subject=50002"], "no avatar in .*50002.*; or give skeleton=file for the skeleton of the motion file"),
        (["skeleton=own"], "skeleton: wanted avatar or file, got 'own'"),
        (["names=maya"], "names: wanted smpl, mixamo, vrm or unreal, got 'maya'"),
        (["bvh.units=inch"], "bvh.units: wanted auto, cm, m or mm, got 'inch'"),
        (["bvh.up=x"], "bvh.up: wanted auto, y or z, got 'x'"),
        (["bvh.order=xyz"], "bvh.order: wanted auto, ZXY,"),
        (["skeleton=file", "output=me.fbx"], "output: wanted a name ending in .bvh, got me.fbx; give format=fbx, or"),
        (["skeleton=file", "height=ground"], "height: wanted file or auto with skeleton=file"),
        (["skeleton=file", "--pose", "dance.bvh", "bvh.units=m"], "bvh.units: wanted auto for the skeleton of dance.bvh"),
        (["skeleton=file", "--pose", "worm.bvh", "names=vrm"], "names=vrm: wanted the skeleton of a human, got one without"),
        (["skeleton=file", "--pose", "nowhere.bvh"], "no BVH file at nowhere.bvh; give the path of one"),
        (["skeleton=file", "motion=[lunge]"], "did you mean 'lunges'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_a_user_can_get_wrong(capsys, arguments, message):
    dance()
    offsets = "{ OFFSET 0 1 0 CHANNELS 3 Zrotation Xrotation Yrotation"
    text = f"HIERARCHY ROOT a {offsets} JOINT b {offsets} }} }}\nMOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0 0 0 0\n"
    Path("worm.bvh").write_text(text)
    code, err = export(capsys, *arguments)
    assert code == 2
    assert re.search(message, err), err
    assert len(err.splitlines()) == 1
    assert not Path("outputs").exists()
