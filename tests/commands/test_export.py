"""`snarf export` end to end, on a chain of bones."""

from __future__ import annotations

import json
import logging
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from glb_reader import GlbReader
from toy_character import JOINTS, ToyCharacter, wave
from toy_human import ToyHuman

from snarfcli.cli.main import main
from snarfcli.commands import selection
from snarfcli.errors import UserError
from snarfcli.export import blender
from snarfcli.export.export import ExportReport
from snarfcli.export.sequence import atomic_folder
from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.skinned import SkinnedSurface

SMALL = ("resolution=40", "triangles=400", "device=cpu")


@pytest.fixture
def toy(monkeypatch) -> ToyCharacter:
    avatar = ToyCharacter()
    avatar.facts = {"subject": "50002"}
    monkeypatch.setattr(selection.Avatar, "load", classmethod(lambda cls, path, device: avatar))
    return avatar


@pytest.fixture
def folder(tmp_path, toy, monkeypatch) -> Path:
    """The run folder, in the current folder."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "outputs" / "builtin" / "50002" / "fast_snarf"
    run.mkdir(parents=True)
    (run / "avatar.pt").write_bytes(b"the toy")
    return run


def pose_file(name: str, frames: int = 5, rate: float = 24.0) -> str:
    motion = wave(frames)
    np.savez(name, poses=motion.poses.reshape(frames, -1), trans=motion.translation, mocap_framerate=rate)
    return name


def export(capsys, *arguments: str) -> tuple[int, str]:
    code = main(["export", *SMALL, "up=y", *arguments])
    return code, capsys.readouterr().err


def test_pose_files_become_clips(folder, capsys, caplog):
    with caplog.at_level(logging.INFO):
        walk, jump = pose_file("walk.npz"), pose_file("jump.npz", 7, 60.0)
        code, err = export(capsys, "--pose", walk, f"--pose={jump}", "--pose", walk)
    assert (code, err) == (0, "")
    path = folder / "export" / "50002.glb"
    assert sorted(file.name for file in path.parent.iterdir()) == ["50002.glb", "50002_glb.json"]
    reader = GlbReader(path)
    assert list(reader.clips) == ["walk", "jump", "walk_2"]
    assert len(reader.faces()) <= 400
    assert max(reader.array(sampler.input).max() for sampler in reader.clips["jump"].samplers) == pytest.approx(6 / 60)
    record = json.loads((path.parent / "50002_glb.json").read_text())
    assert record["bytes"] == path.stat().st_size
    assert record["config"]["influences"] == 4
    assert [(clip["name"], clip["frames"]) for clip in record["clips"]] == [("walk", 5), ("jump", 7), ("walk_2", 5)]
    assert record["truncation_mm"] == reader.gltf.asset.extras["snarf"]["truncation_mm"]
    text = " ".join(caplog.text.split())
    for part in ("4 influences instead of 6", "targets explain", "walk_2 (5 frames, 0.17 s at 24)", "MB", "triangles; 6 j"):
        assert part in text


def test_an_avatar_given_by_its_file_names_what_is_made_of_it(folder, toy, capsys):
    toy.facts = {"subject": "../my dog"}
    Path("elsewhere").mkdir()
    (Path("elsewhere") / "avatar.pt").write_bytes(b"the toy")
    code, err = export(capsys, "--pose", pose_file("walk.npz", 1), "ckpt=elsewhere/avatar.pt")
    assert code == 0, err
    reader = GlbReader(Path("elsewhere/export/my_dog.glb"))
    assert reader.gltf.meshes[0].name == "my_dog"
    assert "my_dog_rig" in [node.name for node in reader.gltf.nodes]
    toy.facts = {}
    assert export(capsys, "--pose", "walk.npz", "ckpt=elsewhere", "format=ply")[0] == 0
    assert Path("elsewhere/export/50002_ply").is_dir()


def test_null_is_no_motion_file(folder, capsys):
    code, err = export(capsys, "pose=null", "motion=null")
    assert code == 2
    assert "got jumping_jacks, which is for SMPL's 24" in err
    pose_file("walk.npz", 1)
    assert export(capsys, "pose=[walk.npz]", "motion=null")[0] == 0


def test_frames_rate_and_place_are_chosen_as_for_animate(folder, capsys):
    pose_file("walk.npz", 9)
    code, err = export(
        capsys, "--pose", "walk.npz", "start=1", "stop=6", "frame_rate=48", "in_place=true", "output=there/me.glb"
    )
    assert code == 0, err
    reader = GlbReader(Path("there/me.glb"))
    assert reader.gltf.animations[0].extras == {"frame_rate": 48, "frames": 9}
    ways = np.stack([reader.values("walk", time)[reader.skin.joints[0], "translation"] for time in (0, 0.1)])
    assert np.ptp(ways[:, [0, 2]], axis=0).max() < 1e-6 < np.ptp(ways[:, 1])


def test_a_page(folder, capsys, caplog):
    with caplog.at_level(logging.INFO):
        walk = pose_file("walk.npz")
        code, err = export(capsys, "--pose", walk, "format=html", "html.title=Nine & one", "html.license=Mine alone.")
    assert (code, err) == (0, "")
    page = (folder / "export" / "50002.html").read_text(encoding="utf-8")
    assert "<h1>Nine &amp; one</h1>" in page
    assert "<p>Licence: Mine alone.</p>" in page
    record = json.loads((folder / "export" / "50002_html.json").read_text())
    assert record["bytes"] == len(page.encode())
    assert record["reduced"] == []
    assert re.search(r"50002\.html: 0\.\d\d MB; open it in a browser", " ".join(caplog.text.split()))
    code, err = export(capsys, "--pose", walk, "format=html")
    assert code == 2
    assert "50002.html exists already; give overwrite=true to replace it" in err
    code, err = export(capsys, "--pose", walk, "format=html", "output=a.htm")
    assert "output: wanted a name ending in .html, got a.htm" in err


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_a_mesh_a_frame(folder, toy, capsys, suffix):
    arguments = ("--pose", pose_file("walk.npz", 4), f"format={suffix}", "weight_colors=true")
    assert export(capsys, *arguments)[0] == 0
    place = folder / "export" / f"50002_{suffix}"
    names = [f"frame_{frame:06d}.{suffix}" for frame in range(4)]
    assert sorted(path.name for path in place.iterdir()) == ["export.json", *names]
    loaded = trimesh.load(place / names[2], process=False)
    motion = wave(4)
    surface = SkinnedSurface(toy, 40, mesh=toy.skinned_surface(40).mesh)
    whole = surface.posed(*(torch.from_numpy(part[2]).float() for part in (motion.poses, motion.translation)))
    assert len(loaded.faces) <= 400 < len(whole.faces)
    assert loaded.is_watertight
    np.testing.assert_allclose(loaded.bounds, whole.bounds, atol=3e-3)  # of decimated and whole mesh
    assert np.ptp(loaded.visual.vertex_colors[:, :3], axis=0).max() > 50
    code, err = export(capsys, *arguments)
    assert code == 2
    assert "already; give overwrite=true" in err
    assert export(capsys, *arguments, "overwrite=true", "max_frames=1")[0] == 0
    assert sorted(path.name for path in place.iterdir()) == ["export.json", names[0]]
    (place / "notes.txt").write_text("mine")
    code, err = export(capsys, *arguments, "overwrite=true")
    assert code == 2
    assert ": wanted only files of such an export, got notes.txt" in err
    assert (place / "notes.txt").exists()


def test_what_meshes_do_not_use_is_said(folder, capsys, caplog):
    arguments = ("--pose", pose_file("walk.npz", 1), "format=ply", "output=out", "overwrite=true")
    assert export(capsys, *arguments)[0] == 0
    assert "not used" not in caplog.text
    assert export(capsys, *arguments, "influences=8", "morph_targets=0")[0] == 0
    assert "influences=8, morph_targets=0: not used with format=ply, whose meshes have all weights" in caplog.text


def test_several_clips_of_meshes_have_a_folder_each(folder, capsys):
    pose_file("walk.npz", 2)
    assert export(capsys, "--pose", "walk.npz", "--pose", "walk.npz", "format=ply", "output=out")[0] == 0
    found = sorted(str(path.relative_to("out")) for path in Path("out").rglob("*.ply"))
    assert found == [f"{clip}/frame_00000{frame}.ply" for clip in ("walk", "walk_2") for frame in range(2)]


def test_clips_of_similar_names_have_a_folder_each_too(folder, capsys):
    names = ["walk 1.npz", "walk_1.npz", "Walk_1.npz", "...npz"]
    poses = [part for name in names for part in ("--pose", pose_file(name, 2))]
    assert export(capsys, *poses, "format=obj", "output=out")[0] == 0
    places = sorted(path.name for path in Path("out").iterdir() if path.is_dir())
    assert places == ["Walk_1_3", "clip", "walk_1", "walk_1_2"]
    assert [len(list((Path("out") / place).glob("*.obj"))) for place in places] == [2, 2, 2, 2]


def test_folders_that_cannot_be_replaced_are_rejected_at_once(folder, toy, capsys, monkeypatch):
    monkeypatch.setattr(toy, "skinned_surface", None)  # nothing is made
    arguments = ("--pose", pose_file("walk.npz", 2), "format=ply", "overwrite=true")
    Path("circle").symlink_to("circle")
    Path("links").mkdir()
    (Path("links") / "frame_000000.ply").symlink_to("nowhere")
    for place, message in (
        (
            ".",
            ".: wanted a folder that can be replaced as a whole, got a disk, a folder in a read-only one, or a parent of ",
        ),
        ("..", "..: wanted a folder that can be replaced as a whole"),
        ("circle", "circle: wanted a folder, got a link that cannot be resolved"),
        ("links", "links: wanted only files of such an export, got frame_000000.ply"),
        ("walk.npz", "walk.npz: wanted a folder, got a file"),
    ):
        code, err = export(capsys, *arguments, f"output={place}")
        assert code == 2, err
        assert message in err
        assert len(err.splitlines()) == 1, err
    assert (Path("links") / "frame_000000.ply").is_symlink()


def test_a_link_to_a_folder_stays_one(folder, capsys):
    arguments = ("--pose", pose_file("walk.npz", 2), "format=ply", "output=link")
    Path("link").symlink_to("real")
    for more in ((), ("overwrite=true",)):
        assert export(capsys, *arguments, *more)[0] == 0
        assert Path("link").is_symlink()
        assert sorted(path.name for path in Path("real").iterdir()) == ["export.json", "frame_000000.ply", "frame_000001.ply"]


def test_new_frames_are_never_lost(tmp_path, monkeypatch):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "frame_000000.ply").write_text("old")
    rename, renamed = Path.rename, []

    def busy(self, target):
        renamed.append(self)
        if self.suffix == ".tmp":
            raise OSError(16, "Device or resource busy")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", busy)
    message = "could not be replaced .Device or resource busy.; the new files are in "
    with pytest.raises(UserError, match=message) as caught, atomic_folder(folder) as temporary:
        (temporary / "frame_000000.ply").write_text("new")
    assert (folder / "frame_000000.ply").read_text() == "old"
    assert (Path(str(caught.value).rpartition(" in ")[2]) / "frame_000000.ply").read_text() == "new"
    assert renamed[0] == folder
    assert len(list(tmp_path.iterdir())) == 2


def test_an_existing_file_stays_until_overwrite(folder, capsys):
    arguments = ("--pose", pose_file("walk.npz", 2))
    path = folder / "export" / "50002.glb"
    path.parent.mkdir()
    path.write_bytes(b"mine")
    (folder / "avatar.pt").unlink()  # rejected before any file is read
    code, err = export(capsys, *arguments)
    assert code == 2
    assert err.endswith("50002.glb exists already; give overwrite=true to replace it, or output=FILE\n")
    assert path.read_bytes() == b"mine"
    (folder / "avatar.pt").write_bytes(b"the toy")
    assert export(capsys, *arguments, "overwrite=true")[0] == 0
    assert path.read_bytes()[:4] == b"glTF"


def test_a_file_where_the_record_goes_stays_until_overwrite(folder, toy, capsys):
    Path("me_glb.json").write_text("mine")
    arguments = ("--pose", pose_file("walk.npz", 1), "output=me.glb")
    code, err = export(capsys, *arguments)
    assert code == 2
    assert "me_glb.json exists already; give overwrite=true to replace it" in err
    assert Path("me_glb.json").read_text() == "mine"
    assert not Path("me.glb").exists()
    assert export(capsys, *arguments, "overwrite=true")[0] == 0
    assert "me.glb" in Path("me_glb.json").read_text()


def test_a_crash_leaves_nothing(folder, capsys, monkeypatch):
    def fail(self, *arguments):
        raise OSError(28, "No space left on device", None)

    pose_file("walk.npz", 3)
    monkeypatch.setattr("snarfcli.export.glb.Path.write_bytes", fail)
    code, err = export(capsys, "--pose", "walk.npz")
    assert code == 2
    assert "the disk is full" in err
    monkeypatch.undo()
    monkeypatch.chdir(folder.parents[3])
    monkeypatch.setattr(selection.Avatar, "load", classmethod(lambda cls, path, device: ToyCharacter()))
    posed, calls = SkinnedSurface.posed, []

    def crash(self, *arguments):
        calls.append(0)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return posed(self, *arguments)

    monkeypatch.setattr(SkinnedSurface, "posed", crash)
    assert export(capsys, "--pose", "walk.npz", "format=ply")[0] == 130
    assert not any(path.is_file() for path in folder.rglob("*") if path.name != "avatar.pt")


def test_an_export_without_its_record_can_be_run_again(folder, toy, capsys, monkeypatch):
    def die(*arguments, **more):
        raise KeyboardInterrupt

    place = folder / "export"
    arguments = ("--pose", pose_file("walk.npz", 2))
    with monkeypatch.context() as patch:
        patch.setattr("snarfcli.commands.export.write_record", die)
        assert export(capsys, *arguments)[0] == 130
    assert json.loads((place / "50002_glb.json").read_text())["complete"] is False
    whole = (place / "50002.glb").read_bytes()
    assert export(capsys, *arguments) == (0, "")
    assert (place / "50002.glb").read_bytes() == whole
    assert json.loads((place / "50002_glb.json").read_text())["complete"] is True
    code, err = export(capsys, *arguments)
    assert code == 2
    assert "50002.glb exists already; give overwrite=true" in err
    with monkeypatch.context() as patch:  # nothing new was written, so the record of what is there stays
        patch.setattr("snarfcli.commands.export.export_character", die)
        assert export(capsys, *arguments, "overwrite=true")[0] == 130
    assert json.loads((place / "50002_glb.json").read_text())["complete"] is True
    assert sorted(path.name for path in place.iterdir()) == ["50002.glb", "50002_glb.json"]


def test_frames_without_shape_end_with_1(folder, capsys, caplog, monkeypatch):
    follow, calls = SkinnedSurface.shape_in, []

    def sometimes(self, pose):
        calls.append(0)
        if len(calls) == 2:
            raise EmptySurface("the field is unoccupied")
        return follow(self, pose)

    monkeypatch.setattr(SkinnedSurface, "shape_in", sometimes)
    assert export(capsys, "--pose", pose_file("walk.npz", 4))[0] == 1
    assert "clip walk, frame 1: the shape could not be computed: the field is unoccupied" in caplog.text
    calls.clear()
    assert export(capsys, "--pose", "walk.npz", "format=ply", "output=out")[0] == 1
    assert sorted(path.name[-5] for path in Path("out").glob("*.ply")) == ["0", "2", "3"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["format=gltf"], "format: wanted glb, html, vrm, bvh, pretrained, ply, obj, fbx or usd, got 'gltf'; did you mean"),
        (["influences=3"], "influences.* 4 or 8, got 3"),
        (["format=vrm", "vrm.modification=all"], "vrm.modification: wanted prohibited, allowModification or"),
        (["triangles=50"], "triangles: wanted 100 to 5000000, got 50"),
        (["triangles=99999999"], "triangles: wanted "),
        (["morph_targets=65"], "morph_targets: wanted 0 to 64, got 65"),
        (["step=0"], "step: wanted at least 1"),
        (["output=me.fbx"], "output: wanted a name ending in .glb, got me.fbx; give format=fbx, or give another name"),
        (["output=me"], "output: wanted a name ending in .glb, got me; give another name"),
        (["output=."], "ending in .glb"),
        (["--pose", "nowhere.npz"], "no pose file at nowhere.npz"),
        (["--pose"], "--pose: wanted a value"),
        (["motion=[jumping_jacks]"], f"motion: wanted one for the avatar's {JOINTS} joints, got jumping_jacks"),
        (["motion=[jumping_jaks]"], "did you mean 'jumping_jacks'"),
        (["subject=50004"], "no avatar in .*50004"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_a_user_can_get_wrong(folder, capsys, arguments, message):
    import re

    code, err = export(capsys, *arguments)
    assert code == 2
    assert re.search(message, err)
    assert len(err.splitlines()) == 1
    assert not (folder / "export").exists()


@pytest.mark.parametrize("logit", [-1.0, 1.0])
@pytest.mark.parametrize("height", ["file", "ground"])  # ground also evaluates the surface
@pytest.mark.parametrize("suffix", ["glb", "ply"])
def test_an_avatar_without_surface_is_a_line(folder, capsys, monkeypatch, logit, suffix, height):
    monkeypatch.setattr(ToyCharacter, "canonical_logits", lambda self, points, pose: torch.full((len(points),), logit))
    code, err = export(capsys, "--pose", pose_file("walk.npz"), f"format={suffix}", f"height={height}")
    assert code == 2
    assert len(err.splitlines()) == 1
    assert "this avatar has no surface to export: the field is" in err
    assert "train it longer" in err
    assert not (folder / "export").exists()


def test_an_avatar_without_weights_is_rejected(folder, toy, capsys, monkeypatch):
    monkeypatch.setattr(ToyCharacter, "has_skinning_weights", False)
    code, err = export(capsys, "--pose", pose_file("walk.npz"))
    assert code == 2
    assert "a rig needs skinning weights of canonical points, which model fast_snarf does not have" in err
    assert not (folder / "export").exists()


# ---------------------------------------------------------------- other names, and VRM
@pytest.fixture
def human(folder, monkeypatch) -> ToyHuman:
    avatar = ToyHuman()
    avatar.facts = {"subject": "50002"}
    monkeypatch.setattr(selection.Avatar, "load", classmethod(lambda cls, path, device: avatar))
    return avatar


def test_joints_get_the_names_of_another_program(human, capsys):
    code, err = export(capsys, "motion=[punching]", "max_frames=2", "names=mixamo", "morph_targets=0")
    assert (code, err) == (0, "")
    reader = GlbReader(Path("outputs/builtin/50002/fast_snarf/export/50002.glb"))
    names = [reader.gltf.nodes[joint].name for joint in reader.skin.joints]
    assert names[:3] == ["mixamorig:Hips", "mixamorig:LeftUpLeg", "mixamorig:RightUpLeg"]


def test_a_vrm_model_and_its_motions(human, capsys, caplog):
    place = Path("outputs/builtin/50002/fast_snarf/export")
    arguments = ("format=vrm", "max_frames=2", "vrm.authors=[me]", "vrm.commercial_usage=corporation", "names=vrm")
    with caplog.at_level(logging.INFO):
        code, err = export(capsys, *arguments, "motion=[punching,lunges]")
    assert (code, err) == (0, "")
    files = ["50002.vrm", "50002_lunges.vrma", "50002_punching.vrma", "50002_vrm.json"]
    assert sorted(path.name for path in place.iterdir()) == files
    assert "clips in 50002_punching.vrma, 50002_lunges.vrma" in caplog.text
    content = (place / "50002.vrm").read_bytes()
    root = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    extension = root["extensions"]["VRMC_vrm"]
    assert extension["meta"]["authors"] == ["me"]
    assert extension["meta"]["commercialUsage"] == "corporation"
    assert root["nodes"][extension["humanoid"]["humanBones"]["leftHand"]["node"]]["name"] == "leftHand"
    record = json.loads((place / "50002_vrm.json").read_text())
    assert record["clip_files"] == [files[2], files[1]]
    (place / "50002.vrm").unlink()
    (place / "50002_vrm.json").unlink()
    code, err = export(capsys, *arguments, "motion=[punching,lunges]")
    assert code == 2
    assert "50002_punching.vrma exists already; give overwrite=true" in err
    assert export(capsys, *arguments, "overwrite=true")[0] == 0
    assert (place / "50002.vrma").exists()  # a single motion has the name of the model
    Path("mine.vrma").write_text("mine")
    code, err = export(capsys, *arguments, "output=mine.vrm")
    assert code == 2
    assert "mine.vrma exists already; give overwrite=true" in err
    assert not Path("mine.vrm").exists()


@pytest.mark.parametrize("arguments", [("format=vrm",), ("names=unreal",)], ids=" ".join)
def test_what_is_no_human_is_a_line_at_once(folder, toy, capsys, monkeypatch, arguments):
    monkeypatch.setattr(toy, "skinned_surface", None)  # nothing is made
    code, err = export(capsys, "--pose", pose_file("walk.npz"), *arguments)
    assert code == 2
    assert len(err.splitlines()) == 1
    assert f"{arguments[0]}: wanted the skeleton of a human, got one without pelvis, " in err
    assert not (folder / "export").exists()


# ---------------------------------------------------------------- through Blender
@pytest.fixture
def fake_blender(tmp_path, monkeypatch):
    """Return a function that makes a program named blender the only one on the path."""
    monkeypatch.setattr(blender.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))

    def install(body: str) -> None:
        (tmp_path / "bin").mkdir()
        program = tmp_path / "bin" / "blender"
        arguments = "glb, path, rate, kind = sys.argv[sys.argv.index('--') + 1 :]"
        program.write_text(f"#!{sys.executable}\nimport sys\n{arguments}\n{body}\n")
        program.chmod(0o755)

    return install


def test_without_blender_one_line_says_how_to_get_it(folder, toy, capsys, fake_blender, monkeypatch):
    monkeypatch.setattr(toy, "skinned_surface", None)  # nothing is made
    code, err = export(capsys, "--pose", pose_file("walk.npz"), "format=fbx")
    assert code == 2
    assert "format: wanted Blender for fbx and usd, got no Blender; pip install 'snarf[blender]'" in err


def test_blender_gets_a_whole_glb(folder, capsys, fake_blender):
    fake_blender("open(path, 'wb').write(open(glb, 'rb').read()[:4] + (rate + kind).encode()); print('snarf: written')")
    assert export(capsys, "--pose", pose_file("walk.npz", 3), "format=fbx")[0] == 0
    assert (folder / "export" / "50002.fbx").read_bytes() == b"glTF24.0fbx"
    assert sorted(path.name for path in (folder / "export").iterdir()) == ["50002.fbx", "50002_fbx.json"]
    code, err = export(capsys, "--pose", "walk.npz", "--pose", "walk.npz", "format=usd")
    assert code == 2
    assert "usd: wanted one motion, got 2" in err


@pytest.mark.parametrize("kind", ["fbx", "usd"])
def test_blender_is_told_the_format_for_any_case_of_the_suffix(folder, capsys, fake_blender, kind):
    fake_blender("open(path, 'w').write(kind + path[-4:]); print('snarf: written')")
    assert export(capsys, "--pose", pose_file("walk.npz", 2), f"format={kind}", f"output=ME.{kind.upper()}")[0] == 0
    assert Path(f"ME.{kind.upper()}").read_text() == f"{kind}.{kind}"


def test_a_crash_of_blender_leaves_nothing(folder, capsys, fake_blender):
    fake_blender("open(path, 'wb').write(b'half'); print('about to'); sys.exit('Error: out of patience')")
    code, err = export(capsys, "--pose", pose_file("walk.npz", 2), "format=fbx")
    assert code == 2
    assert "Blender could not write 50002.fbx (Error: out of patience); give format=glb" in err
    assert not (folder / "export").exists()


def test_the_report_says_what_a_clip_lasts():
    numbers = {"max_mm": 0.0, "p99_mm": 0.0, "rms_mm": 0.0}
    report = ExportReport(Path("a.glb"), 1, 1, 1, 1, 4, numbers, 0, numbers, numbers, numbers, ())
    assert report.morph_share == 1
    assert "0 morph targets explain 100.0 %" in " ".join(report.lines())
