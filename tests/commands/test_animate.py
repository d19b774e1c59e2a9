"""`snarf animate` end to end, on two capsules end to end and on an untrained avatar."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import trimesh
from PIL import Image
from toy_avatar import LENGTH, RADIUS, ToyAvatar

from snarfcli.avatar import Avatar
from snarfcli.cli.main import main
from snarfcli.commands import animate, selection
from snarfcli.commands.animate import AnimateConfig, run
from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError
from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.motions import Motion

VOLUME = np.pi * RADIUS**2 * 2 * LENGTH + 4 / 3 * np.pi * RADIUS**3


@pytest.fixture
def toy(monkeypatch) -> ToyAvatar:
    avatar = ToyAvatar()
    monkeypatch.setattr(Avatar, "load", classmethod(lambda cls, path, device: avatar))
    return avatar


@pytest.fixture
def pose_file(tmp_path: Path) -> Path:
    poses = np.zeros((6, 6))
    poses[:, 1] = 0.3  # turned about the vertical
    poses[:, 5] = np.linspace(0, 1.2, 6)
    trans = np.stack([np.linspace(0, 0.5, 6), np.full(6, 0.9), np.zeros(6)], axis=1)
    path = tmp_path / "wave.npz"
    np.savez(path, poses=poses, trans=trans, mocap_framerate=24.0)
    return path


@pytest.fixture
def config(tmp_path: Path, pose_file: Path, toy: ToyAvatar) -> AnimateConfig:
    folder = tmp_path / "outputs" / "builtin" / "50002" / "fast_snarf"
    folder.mkdir(parents=True)
    (folder / "avatar.pt").write_bytes(b"the toy")
    return AnimateConfig(
        subject="50002",
        data=DataConfig("builtin", 8, 1, 1),
        output_root=str(tmp_path / "outputs"),
        run="fast_snarf",
        ckpt=None,
        pose=str(pose_file),
        up="y",
        hands="rest",
        rest="auto",
        mapping=None,
        clip=None,
        data_root=str(tmp_path / "data"),
        motion="jumping_jacks",
        motion_seed=0,
        motion_frame_rate=30.0,
        start=0,
        stop=None,
        step=1,
        frame_rate=None,
        max_frames=None,
        in_place=False,
        surface="field",
        resolution=32,
        keep_share=0.01,
        meshes=True,
        format="ply",
        weight_colors=False,
        video=True,
        video_size="64",
        views=["front"],
        azimuth_deg=0.0,
        camera="still",
        turntable="false",
        beside=[],
        processes="1",
        elevation_deg=5.0,
        output=None,
        overwrite=False,
        device="cpu",
        threads=None,
    )


def folder_of(config: AnimateConfig) -> Path:
    return Path(config.output_root) / "builtin" / "50002" / "fast_snarf" / "animation" / "wave"


def record_of(config: AnimateConfig) -> dict:
    return json.loads((folder_of(config) / "animation.json").read_text())


def video_frames(path: Path) -> tuple[dict, list[np.ndarray]]:
    reader = imageio_ffmpeg.read_frames(str(path))
    facts = next(reader)
    width, height = facts["size"]
    return facts, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def test_meshes_video_and_record(config, toy):
    assert run(replace(config, video_size="80x64")) == 0
    folder = folder_of(config)
    names = [f"frame_{index:06d}.ply" for index in range(6)]
    assert sorted(path.name for path in folder.iterdir()) == ["animation.json", *names, "poster.png", "video.mp4"]
    solids = [trimesh.load(folder / name, process=False) for name in names]
    for solid in solids:
        assert solid.is_watertight
        assert solid.volume == pytest.approx(VOLUME, rel=0.15)
    # translation and global orientation are kept: the root end of the capsules travels with trans
    assert solids[-1].bounds[0, 0] - solids[0].bounds[0, 0] == pytest.approx(0.5, abs=0.05)
    assert solids[0].bounds[0, 1] == pytest.approx(0.9 - RADIUS, abs=0.02)
    assert solids[0].vertices[:, 2].min() < -0.2
    facts, frames = video_frames(folder / "video.mp4")
    assert facts["size"] == (80, 64)
    assert facts["fps"] == pytest.approx(24)
    assert len(frames) == 6
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1  # it moves
    record = record_of(config)
    assert record["complete"]
    assert record["skipped"] == []
    assert [frame["file"] for frame in record["frames"]] == names
    assert all(frame["components"] == 1 and frame["points"] > 0 for frame in record["frames"])
    assert record["motion"] == {"name": "wave", "frames": 6, "frame_rate": 24.0}


def test_frame_range_step_and_pace(config):
    assert run(replace(config, start=1, stop=6, step=2, max_frames=2, surface="skinned", format="obj")) == 0
    folder = folder_of(config)
    assert sorted(path.name for path in folder.glob("frame_*")) == ["frame_000000.obj", "frame_000001.obj"]
    assert [frame["frame"] for frame in record_of(config)["frames"]] == [1, 3]
    facts, frames = video_frames(folder / "video.mp4")
    assert facts["fps"] == pytest.approx(12)
    assert len(frames) == 2


@pytest.mark.parametrize("surface", ["field", "skinned"])
def test_weight_colors_differ_between_the_bones(config, surface):
    assert run(replace(config, max_frames=1, weight_colors=True, surface=surface, video=False)) == 0
    solid = trimesh.load(folder_of(config) / "frame_000000.ply", process=False)
    colors = solid.visual.vertex_colors[:, :3].astype(int)
    # the first bone starts where trans puts the root, the second ends a metre further
    distance = np.linalg.norm(solid.vertices - (0, 0.9, 0), axis=1)
    near, far = colors[distance < 1.5 * RADIUS].mean(axis=0), colors[distance > 2 * LENGTH - RADIUS].mean(axis=0)
    assert np.abs(near - far).max() > 60
    assert not (folder_of(config) / "video.mp4").exists()


def test_views_and_contents_side_by_side(config):
    beside = ["canonical", "skinned", "weights"]
    assert run(replace(config, max_frames=3, views=["front", "top"], beside=beside, video_size="48x40", turntable="90")) == 0
    facts, frames = video_frames(folder_of(config) / "video.mp4")
    poster = np.asarray(Image.open(folder_of(config) / "poster.png")).astype(int)
    assert facts["size"] == (2 * 48 + 2, poster.shape[0] + poster.shape[0] % 2)
    assert len(frames) == 3
    assert np.abs(frames[1][: poster.shape[0], : poster.shape[1]] - poster).mean() < 6  # the middle of the video
    strip = poster.shape[0] // 4 - 40
    panels = [[poster[row * (40 + strip) :][:40, column * 49 :][:, :48] for column in range(2)] for row in range(4)]
    for column in range(2):
        assert np.abs(panels[0][column] - panels[2][column]).mean() < 3  # the same body in the same place
    colors = [np.ptp(panel, axis=2).max() for panel, _ in panels]
    assert colors[3] > colors[0] + 40  # only the weights are coloured
    assert record_of(config)["poster"] == "poster.png"


def test_meshes_do_not_depend_on_what_is_beside(config, tmp_path):
    """Otherwise a continued run with other panels would mix two kinds of colours."""
    written = []
    for beside in ([], ["weights"]):
        folder = tmp_path / f"beside_{len(beside)}"
        assert run(replace(config, max_frames=2, weight_colors=True, beside=beside, output=str(folder))) == 0
        written.append((folder / "frame_000001.ply").read_bytes())
    assert written[0] == written[1]


def test_what_is_missing_beside_is_no_missing_frame(config, toy, monkeypatch, caplog):
    def posed(self, *arguments, **keywords):
        raise EmptySurface("nothing there")

    monkeypatch.setattr(SkinnedSurface, "posed", posed)
    assert run(replace(config, max_frames=2, beside=["skinned"])) == 1
    record = record_of(config)
    assert record["skipped"] == []
    assert [frame["file"] for frame in record["frames"]] == ["frame_000000.ply", "frame_000001.ply"]
    assert [entry["reason"] for entry in record["missing"]] == ["skinned surface: nothing there"] * 2
    assert "2 of 2 frames without a panel beside the avatar" in caplog.text


def test_truth_is_shown_where_there_is_some(config, toy, tmp_path, monkeypatch):
    toy.facts = {"data": "meshes", "subject": "50002"}
    with pytest.raises(UserError, match=r"beside=\[truth\]: pose files have no ground truth with data=meshes"):
        run(replace(config, beside=["truth"]))
    solid = trimesh.creation.box((0.4, 0.2, 0.2))
    meshes = [(np.add(solid.vertices, (2 * frame, 1, 0)), solid.faces) for frame in range(6)]
    monkeypatch.setattr(animate, "ground_truth_meshes", lambda *arguments: meshes)
    assert run(replace(config, beside=["truth"], max_frames=2, output=str(tmp_path / "out"))) == 0
    _, frames = video_frames(tmp_path / "out" / "video.mp4")
    is_clay = [frame[:64, 65:].astype(int) @ (1, 0, -1) > 30 for frame in frames]
    middle = [np.nonzero(panel)[1].mean() for panel in is_clay]
    assert middle[1] > middle[0] + 20
    assert not is_clay[1][:, -1].any()


def test_an_interrupted_run_goes_on(config, toy, monkeypatch, caplog):
    extract = animate.Animation._extract

    def interrupted(self, index, frame):
        if index == 3:
            raise KeyboardInterrupt
        return extract(self, index, frame)

    monkeypatch.setattr(animate.Animation, "_extract", interrupted)
    with caplog.at_level(logging.INFO), pytest.raises(KeyboardInterrupt):
        run(config)
    assert "stopped after 3 of 6 frames" in caplog.text
    folder = folder_of(config)
    assert sorted(path.name for path in folder.iterdir()) == [
        "animation.json", "frame_000000.ply", "frame_000001.ply", "frame_000002.ply",
    ]  # fmt: skip
    assert record_of(config)["complete"] is False
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.ply")}
    (folder / ".frame_000003.1a2b3c4d.tmp.ply").write_bytes(b"half of a mesh, by a process that was killed")

    monkeypatch.setattr(animate.Animation, "_extract", extract)
    with caplog.at_level(logging.INFO):
        assert run(config) == 0
    assert "3 existed already" in caplog.text
    assert not list(folder.glob(".*"))
    assert {name: (folder / name).stat().st_mtime_ns for name in before} == before
    assert len(video_frames(folder / "video.mp4")[1]) == 6
    assert record_of(config)["complete"] is True


def test_other_settings_are_rejected_and_overwrite_starts_again(config):
    short = replace(config, max_frames=2, video=False)
    run(short)
    with pytest.raises(UserError, match=r"resolution 32 \(now 24\); give overwrite=true to replace them, or output="):
        run(replace(short, resolution=24))
    with pytest.raises(UserError, match=r"step 1 \(now 2\)"):
        run(replace(short, step=2))
    first = (folder_of(config) / "frame_000000.ply").stat().st_mtime_ns
    assert run(replace(short, max_frames=3)) == 0  # a longer part of the same motion keeps the existing frames
    assert (folder_of(config) / "frame_000000.ply").stat().st_mtime_ns == first
    assert (folder_of(config) / "frame_000002.ply").exists()
    (Path(config.output_root) / "builtin" / "50002" / "fast_snarf" / "avatar.pt").write_bytes(b"trained again")
    with pytest.raises(UserError, match="frames made with another avatar"):
        run(short)
    assert run(replace(short, max_frames=1, format="obj", overwrite=True)) == 0
    assert sorted(path.name for path in folder_of(config).iterdir()) == ["animation.json", "frame_000000.obj"]
    assert run(replace(short, output=str(folder_of(config).parent / "elsewhere"))) == 0


def test_files_of_others_are_not_deleted(config, tmp_path):
    mine = tmp_path / "mine" / "frame_0001.ply"
    mine.parent.mkdir()
    mine.write_text("not by this program")
    short = replace(config, max_frames=1, video=False, output=str(mine.parent))
    with pytest.raises(UserError, match=r"has frame_0001.ply of unknown origin; give overwrite=true"):
        run(short)
    assert mine.exists()
    (mine.parent / "animation.json").write_text("[]")
    with pytest.raises(UserError, match="is not the record of an animation"):
        run(short)
    assert run(replace(short, overwrite=True)) == 0
    assert not mine.exists()


def test_a_frame_without_surface_is_reported_and_the_rest_goes_on(config, toy, monkeypatch, caplog):
    query = toy.query

    def sometimes(points, transforms, pose):
        samples = query(points, transforms, pose)
        if 0.4 < pose[0, 1, 2] < 0.5:
            samples.logits = samples.logits * 0 - 1
        return samples

    monkeypatch.setattr(toy, "query", sometimes)
    assert run(config) == 1
    assert "frame 2: the field is unoccupied" in caplog.text
    record = record_of(config)
    assert [skip["frame"] for skip in record["skipped"]] == [2]
    assert record["frames"][2]["file"] is None
    assert len(list(folder_of(config).glob("*.ply"))) == 5
    assert len(video_frames(folder_of(config) / "video.mp4")[1]) == 6


def test_an_avatar_without_any_surface_still_ends_in_order(config, toy):
    toy.radius = -1.0
    assert run(replace(config, max_frames=2, weight_colors=True)) == 1
    assert len(record_of(config)["skipped"]) == 2
    with pytest.raises(EmptySurface):
        animate.canonical_surface(toy, toy.skeleton.canonical_pose, 32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"surface": "feild"}, "surface: wanted field or skinned, got 'feild'; did you mean 'field'"),
        ({"format": "stl"}, "format: wanted ply or obj, got 'stl'"),
        ({"up": "w"}, "up: wanted auto, y, z, x, -y, -z or -x"),
        ({"hands": "fists"}, "hands: wanted rest or released, got 'fists'"),
        (
            {"clip": "walk"},
            "clip: wanted a file ending in .bvh, .glb, .gltf, .*, got pose file .*wave.npz with one motion; leave it out",
        ),
        ({"resolution": 15}, "resolution: wanted 16 to 1024, got 15"),
        ({"keep_share": 1.5}, "keep_share: wanted 0 to 1, got 1.5"),
        ({"step": 0}, "step: wanted at least 1"),
        ({"max_frames": 0}, "max_frames: wanted at least 1"),
        ({"start": 6}, "start=6, stop=null leave no frame; wave has frames 0 to 5"),
        ({"meshes": False, "video": False}, "meshes, video: wanted at least one"),
        ({"video_size": "large"}, "video_size: wanted pixels such as 512 or 1280x720"),
        ({"video_size": "9000"}, "video_size: wanted"),
        ({"video_size": "2000", "views": ["front", "left", "back", "right", "top"]}, "5 panels .* smaller video_size"),
        ({"views": ["frnt"]}, "got 'frnt'; did you mean 'front'"),
        ({"views": []}, "views.* 1 to 8"),
        ({"camera": "folow"}, "camera: wanted still or follow, got 'folow'; did you mean 'follow'"),
        ({"turntable": "fast"}, "turntable.* true, false or degrees"),
        ({"beside": ["thruth"]}, "beside: wanted canonical, truth.* got 'thruth'; did you mean 'truth'"),
        ({"beside": ["field"]}, r"beside=\[field\]: surface=field shows this already"),
        ({"beside": ["weights", "weights"]}, "beside: wanted each panel once, got 'weights' twice"),
        ({"processes": "many"}, "processes.* auto or a number from 1 to 64, got 'many'"),
        ({"elevation_deg": 90.0}, "elevation_deg: wanted "),
        ({"pose": None, "motion_frame_rate": 0.0}, "motion_frame_rate: wanted "),
        ({"azimuth_deg": float("nan")}, "azimuth_deg: wanted "),
        ({"pose": None, "motion_seed": -1}, "motion_seed: wanted at least 0"),
        (
            {"pose": None},
            "motion: wanted one for the avatar's 2 joints, got jumping_jacks, .* 24; give .* by --pose FILE",
        ),
        ({"pose": None, "motion": "jumping_jaks"}, "did you mean 'jumping_jacks'"),
        ({"pose": "nowhere.npz"}, "no pose file at nowhere.npz; give the path of one, or motion=NAME"),
        ({"subject": "50003"}, "no built-in subject '50003'"),
        ({"subject": "50004"}, 'no avatar in .*50004.*; run "snarf train subject=50004 output_root=.*" or give ckpt=PATH'),
        ({"ckpt": "nowhere.pt"}, "no avatar at nowhere.pt"),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_what_a_user_can_get_wrong(config, change, message):
    with pytest.raises(UserError, match=message):
        run(replace(config, **change))
    assert not folder_of(config).exists()


def test_a_motion_of_another_skeleton_is_rejected(config, tmp_path):
    np.savez(tmp_path / "smpl.npz", poses=np.zeros((2, 72)), trans=np.zeros((2, 3)))
    with pytest.raises(UserError, match="wanted 6 values per frame, got 72"):
        run(replace(config, pose=str(tmp_path / "smpl.npz")))


def test_a_bvh_of_the_avatars_own_joints(config, tmp_path):
    path = tmp_path / "bend.bvh"
    path.write_text(
        "HIERARCHY\nROOT joint_0 { OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
        f"JOINT joint_1 {{ OFFSET {LENGTH} 0 0 CHANNELS 3 Zrotation Xrotation Yrotation\n"
        f"End Site {{ OFFSET {LENGTH} 0 0 }} }} }}\n"
        "MOTION\nFrames: 2\nFrame Time: 0.05\n0 0 0 0 0 0 0 0 0\n0 0 2 0 0 0 0 0 40\n"
    )
    assert run(replace(config, pose=str(path), video=False, output=str(tmp_path / "out"))) == 0
    bounds = [trimesh.load(tmp_path / "out" / f"frame_{frame:06d}.ply", process=False).bounds for frame in range(2)]
    assert bounds[0][1, 0] == pytest.approx(2 * LENGTH + RADIUS, abs=0.05)
    assert bounds[1][1, 2] == pytest.approx(2 + RADIUS, abs=0.05)
    assert bounds[1][0, 2] < 2 - 0.25


def test_the_command_line(config, pose_file, capsys):
    arguments = [
        "animate", "--pose", str(pose_file), "up=y", f"output_root={config.output_root}", "resolution=24", "max_frames=2",
        "video_size=64", "device=cpu", "views=[45,back]", "turntable=true", "camera=follow", "beside=[skinned]", "processes=1",
    ]  # fmt: skip
    assert main(arguments) == 0
    assert len(video_frames(folder_of(config) / "video.mp4")[1]) == 2
    assert main([*arguments, "resolution=32"]) == 2
    assert "give overwrite=true" in capsys.readouterr().err


def test_another_skeleton_moves_as_its_samples_do(config, toy, tmp_path, monkeypatch):
    """Joints that stretch follow the bone transforms of the samples."""
    poses = np.zeros((2, 2, 3))
    motion = Motion("wave", poses, np.zeros((2, 3)), 24.0)
    transforms = np.tile(np.eye(4, dtype=np.float32), (2, 2, 1, 1))
    transforms[1, :, 1, 3] = 0.7
    asked = []

    def stored(*arguments):
        asked.append(arguments[1:4])
        return motion, transforms

    monkeypatch.setattr(selection, "stored_motion", stored)
    other = replace(config, data=DataConfig("meshes", 1, 1, 1), pose=None, motion=None, ckpt=str(tmp_path / "avatar.pt"))
    (tmp_path / "avatar.pt").write_bytes(b"the toy")
    assert run(replace(other, output=str(tmp_path / "out"))) == 0
    assert asked == [("meshes", "50002", None)]
    low, high = (trimesh.load(tmp_path / "out" / f"frame_{index:06d}.ply").centroid[1] for index in range(2))
    assert high - low == pytest.approx(0.7, abs=0.01)
