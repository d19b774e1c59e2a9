"""The exported file against the avatar's skinned surface, as independent readers see it."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest
import torch
import trimesh
from glb_reader import GlbReader, needs_readers, run_reader
from toy_character import BULGE, FRAME_RATE, JOINTS, ToyCharacter, stretched, wave

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.errors import UserError
from snarfcli.export import character_glb
from snarfcli.export.character import CharacterOptions
from snarfcli.export.character_surface import character_surface
from snarfcli.export.clips import Clip
from snarfcli.export.export import export_character
from snarfcli.formats.gltf import read_gltf
from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.skinned import SkinnedSurface

WHOLE = CharacterOptions(triangles=None, morph_targets=8, resolution=40)
FEW = replace(WHOLE, triangles=600)
TOLERANCE_M = 5e-4
FRAMES = (0, 1, 5, 12)


@pytest.fixture(scope="module")
def toy() -> ToyCharacter:
    return ToyCharacter()


@pytest.fixture(scope="module")
def exported(toy, tmp_path_factory):
    """Two clips of different pace in one file, with the surface that they are of."""
    path = tmp_path_factory.mktemp("export") / "worm.glb"
    clips = [Clip(wave()), Clip(wave(31, "fast", -0.5, 60.0))]
    return path, export_character(toy, path, clips, WHOLE), toy.skinned_surface(WHOLE.resolution), clips


def posed(surface: SkinnedSurface, clip: Clip, frame: int) -> np.ndarray:
    pose, translation = (torch.from_numpy(part[frame]).float() for part in (clip.motion.poses, clip.motion.translation))
    transforms = None if clip.bone_transforms is None else torch.from_numpy(clip.bone_transforms[frame]).float()
    return surface.posed(pose, translation, transforms).vertices


def largest(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b, axis=1).max())


def allowed(report) -> float:
    """What the readers may be off: half a millimetre more than is printed."""
    return TOLERANCE_M + 1e-3 * report.truncation_mm["max_mm"]


def test_numpy_skinning_gives_the_skinned_surface(exported):
    path, report, surface, clips = exported
    reader = GlbReader(path)
    assert report.truncation_mm["max_mm"] > 0.3  # a smooth skin over six bones is not that of four
    assert report.shape_motion_mm["max_mm"] > 300 * BULGE
    for clip in clips:
        for frame in FRAMES:
            found = reader.vertices(clip.motion.name, frame / clip.motion.frame_rate)
            assert largest(found, posed(surface, clip, frame)) < allowed(report)


def test_the_printed_deviation_is_what_a_reader_finds(exported):
    path, report, surface, clips = exported
    reader = GlbReader(path)
    errors = [
        largest(reader.vertices(clip.motion.name, frame / clip.motion.frame_rate), posed(surface, clip, frame))
        for clip in clips
        for frame in range(clip.motion.num_frames)
    ]
    # float32 on both sides: the surface's own skinning, and the numbers in the file
    assert 1000 * max(errors) == pytest.approx(report.deviation_mm["max_mm"], abs=0.01)
    assert report.deviation_mm["max_mm"] <= report.truncation_mm["max_mm"] + report.morph_error_mm["max_mm"] * 2


def test_between_keys_the_joints_turn_evenly(toy, tmp_path):
    """Half-way between two keys the file stands where the motion stands, resampled at twice the rate."""
    motion = wave(7)
    export_character(toy, tmp_path / "worm.glb", [Clip(motion)], replace(WHOLE, influences=8, morph_targets=0))
    finer = motion.resampled(2 * FRAME_RATE)
    reader = GlbReader(tmp_path / "worm.glb")
    positions, weights = reader.attribute("POSITION"), reader.dense_weights()
    for frame in (1, 6, 11):
        transforms = toy.skeleton.to(torch.float64).posed_from_canonical(
            torch.from_numpy(finer.poses[frame][None]), torch.from_numpy(finer.translation[frame][None])
        )
        wanted = skin_vertices(positions, weights, transforms[0].numpy())
        assert largest(reader.vertices("wave", frame / finer.frame_rate), wanted) < 1e-5  # float32 keys


def test_eight_influences_leave_nothing_out(toy, tmp_path):
    """Six bones are all among eight influences, and three poses are two shapes and their mean: nothing is left."""
    motion = wave(3)
    report = export_character(toy, tmp_path / "worm.glb", [Clip(motion)], replace(WHOLE, influences=8))
    assert report.truncation_mm["max_mm"] < 1e-3
    assert report.morph_error_mm["max_mm"] < 1e-2
    reader = GlbReader(tmp_path / "worm.glb")
    assert reader.primitive.attributes.JOINTS_1 is not None
    np.testing.assert_allclose(reader.dense_weights().sum(1), 1, atol=1e-6)
    surface = toy.skinned_surface(WHOLE.resolution)
    for frame in range(3):
        assert largest(reader.vertices("wave", frame / FRAME_RATE), posed(surface, Clip(motion), frame)) < 2e-5


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_joints_that_stretch_and_grow(toy, tmp_path, scale):
    clip = stretched(wave(5), toy, scale)
    report = export_character(toy, tmp_path / "worm.glb", [clip], WHOLE)
    reader, surface = GlbReader(tmp_path / "worm.glb"), toy.skinned_surface(WHOLE.resolution)
    for frame in (0, 3, 4):
        assert largest(reader.vertices("wave", frame / FRAME_RATE), posed(surface, clip, frame)) < allowed(report)
    paths = {(channel.target.node, channel.target.path) for channel in reader.clips["wave"].channels}
    assert ((reader.skin.joints[3], "scale") in paths) == (scale != 1)
    assert (reader.skin.joints[3], "translation") in paths
    assert (reader.skin.joints[2], "translation") not in paths


def test_the_nodes_are_the_skeleton(exported, toy):
    path, _, _, _clips = exported
    reader = GlbReader(path)
    nodes = reader.gltf.nodes
    assert [nodes[joint].name for joint in reader.skin.joints] == list(toy.skeleton.names)
    for joint, parent in enumerate(toy.skeleton.parents[1:], 1):
        assert reader.parents[reader.skin.joints[joint]] == reader.skin.joints[parent]
    bind = np.linalg.inv(reader.array(reader.skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1))
    np.testing.assert_allclose(bind[:, :3, 3], toy.skeleton.canonical_joints, atol=1e-6)
    # standing nodes are the bind pose
    np.testing.assert_allclose([reader._world(joint, {}, {}) for joint in reader.skin.joints], bind, atol=1e-6)
    assert nodes[reader.mesh_node].translation is None
    assert reader.mesh_node not in reader.parents


def test_clips_keep_their_times_and_the_way_of_the_root(exported):
    path, report, _, clips = exported
    reader = GlbReader(path)
    assert [clip.name for clip in report.clips] == ["wave", "fast"]
    for clip in clips:
        motion = clip.motion
        times = max((reader.array(s.input) for s in reader.clips[motion.name].samplers), key=len)
        np.testing.assert_allclose(times, np.arange(motion.num_frames) / motion.frame_rate, atol=1e-6)
        for frame in FRAMES:
            root = reader.values(motion.name, frame / motion.frame_rate)[reader.skin.joints[0], "translation"]
            np.testing.assert_allclose(root, motion.translation[frame], atol=1e-5)  # the rest root is at the origin


def test_channels_that_stand_still_are_short_and_needless_ones_left_out(exported):
    reader = GlbReader(exported[0])
    keys = {}
    for channel in reader.clips["wave"].channels:
        sampler = reader.clips["wave"].samplers[channel.sampler]
        keys[channel.target.node, channel.target.path] = len(reader.array(sampler.input))
    joints = reader.skin.joints
    assert keys[joints[1], "rotation"] == 13
    assert (joints[JOINTS - 1], "rotation") not in keys  # stands as its node does, in every clip
    assert [node for node, path in keys if path == "translation"] == [joints[0]]


def test_a_still_clip_is_as_long_as_it_was(toy, tmp_path):
    motion = wave(1)
    still = replace(motion, poses=np.repeat(motion.poses, 9, 0), translation=np.repeat(motion.translation, 9, 0))
    export_character(toy, tmp_path / "a.glb", [Clip(still)], FEW)
    reader = GlbReader(tmp_path / "a.glb")
    lengths = {tuple(np.round(reader.array(sampler.input), 5)) for sampler in reader.clips["wave"].samplers}
    assert lengths == {(0.0, round(8 / FRAME_RATE, 5))}
    report = export_character(toy, tmp_path / "b.glb", [Clip(motion)], FEW)  # a single pose
    assert report.clips[0].frames == 1
    assert report.morph_targets == 0
    assert report.morph_share == 1
    surface = character_surface(toy, FEW)
    assert largest(GlbReader(tmp_path / "b.glb").vertices("wave", 0), posed(surface, Clip(motion), 0)) < allowed(report)


def test_a_decimated_mesh_stays_on_the_surface(toy, tmp_path):
    report = export_character(toy, tmp_path / "worm.glb", [Clip(wave())], FEW)
    assert 500 < report.triangles <= 600
    reader = GlbReader(tmp_path / "worm.glb")
    fine = toy.skinned_surface(WHOLE.resolution)
    solid = trimesh.Trimesh(posed(fine, Clip(wave()), 5), fine.mesh.faces, process=False)
    found = reader.vertices("wave", 5 / FRAME_RATE)
    distance = np.sqrt(igl.point_mesh_squared_distance(found, solid.vertices, solid.faces)[0])
    # Vertices are on the level set, but triangles of 3 cm cut corners of a tube of 6 cm: chords leave it by 1.5 mm.
    assert distance.max() < allowed(report) + 1.5e-3
    own = trimesh.Trimesh(reader.vertices("wave", 5 / FRAME_RATE), reader.faces(), process=False)
    assert own.is_watertight
    assert own.volume == pytest.approx(solid.volume, rel=0.03)
    normals = reader.attribute("NORMAL")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)


def test_more_targets_leave_less(toy, tmp_path):
    clips = [Clip(wave())]
    reports = [export_character(toy, tmp_path / f"{k}.glb", clips, replace(FEW, morph_targets=k)) for k in (0, 2, 4)]
    assert [report.morph_targets for report in reports] == [0, 2, 4]
    errors = [report.morph_error_mm["rms_mm"] for report in reports]
    assert errors[0] == reports[0].shape_motion_mm["rms_mm"]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert reports[0].morph_share == 0
    assert reports[2].morph_share > 0.99
    reader = GlbReader(tmp_path / "4.glb")
    assert reader.mesh.extras["targetNames"] == [f"shape_{number}" for number in range(4)]
    weights = np.stack([reader.values("wave", frame / FRAME_RATE)[reader.mesh_node, "weights"] for frame in range(13)])
    assert weights.min() == 0
    assert weights.max() == 1
    assert GlbReader(tmp_path / "0.glb").primitive.targets in (None, [])


def test_an_avatar_of_one_shape_needs_no_targets(tmp_path):
    report = export_character(ToyCharacter(bulge=0.0), tmp_path / "worm.glb", [Clip(wave())], FEW)
    assert report.morph_targets == 0
    assert report.morph_error_mm["max_mm"] < 0.02


def test_colors_are_linear(toy, tmp_path):
    export_character(toy, tmp_path / "worm.glb", [Clip(wave(2))], replace(FEW, weight_colors=True))
    reader = GlbReader(tmp_path / "worm.glb")
    color = reader.attribute("COLOR_0")
    from snarfcli.meshing.colors import weights_to_colors

    wanted = weights_to_colors(character_surface(toy, FEW).mesh.weights) / 255
    back = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(back[:, :3], wanted, atol=1e-3)
    assert (color[:, 3] == 1).all()


def test_other_readers_of_python(exported):
    path, _, surface, _clips = exported
    scene = trimesh.load(path)
    (solid,) = scene.geometry.values()
    assert solid.faces.shape == surface.mesh.faces.shape
    rig = read_gltf(path)
    assert [(clip.frame_rate, len(clip.world_from_joint)) for clip in rig.clips] == [(FRAME_RATE, 13), (60, 31)]
    assert [clip.name for clip in rig.clips] == ["wave", "fast"]
    assert rig.names == tuple(f"bone_{j}" for j in range(JOINTS))
    reader = GlbReader(path)
    assert rig.clips[0].world_from_joint.shape == (13, JOINTS, 4, 4)
    for joint, number in enumerate(reader.skin.joints):
        np.testing.assert_allclose(
            rig.clips[0].world_from_joint[7, joint], reader._world(number, reader.values("wave", 7 / FRAME_RATE), {}), atol=1e-6
        )


@needs_readers
@pytest.mark.parametrize("options", [WHOLE, replace(FEW, influences=8, weight_colors=True), replace(FEW, morph_targets=0)])
def test_the_khronos_validator_has_nothing_to_say(toy, tmp_path, options):
    clips = [Clip(wave(3)), Clip(wave(1)), stretched(wave(4), toy, 1.2)]
    export_character(toy, tmp_path / "worm.glb", clips, options)
    report = run_reader("validate.mjs", tmp_path / "worm.glb")
    assert report["issues"]["messages"] == []
    assert report["info"]["animationCount"] == 3
    assert report["info"]["maxInfluences"] == options.influences


@needs_readers
def test_three_js_gives_the_skinned_surface(exported):
    path, report, surface, clips = exported
    for clip in clips:
        motion = clip.motion
        found = run_reader("three.mjs", path, motion.name, *(frame / motion.frame_rate for frame in FRAMES))
        for frame, vertices in zip(FRAMES, found["frames"], strict=True):
            assert largest(np.array(vertices), posed(surface, clip, frame)) < allowed(report)
        (facts,) = [facts for facts in found["clips"] if facts["name"] == motion.name]
        assert facts["keys"] == motion.num_frames
        assert facts["duration"] == pytest.approx((motion.num_frames - 1) / motion.frame_rate, abs=1e-5)
    assert found["bones"] == [f"bone_{joint}" for joint in range(JOINTS)]
    assert len(found["morphs"]) == report.morph_targets


def test_frames_that_cannot_be_followed_are_reported_and_blended(toy, tmp_path, monkeypatch):
    follow = SkinnedSurface.canonical_vertices
    bad = torch.from_numpy(wave().poses[6]).float()

    def sometimes(self, pose):
        if torch.equal(pose, bad):
            raise EmptySurface("the field is unoccupied")
        return follow(self, pose)

    monkeypatch.setattr(SkinnedSurface, "canonical_vertices", sometimes)
    report = export_character(toy, tmp_path / "worm.glb", [Clip(wave())], FEW)
    assert report.skipped == (("wave", 6, "the field is unoccupied"),)
    reader = GlbReader(tmp_path / "worm.glb")
    weights = [reader.values("wave", frame / FRAME_RATE)[reader.mesh_node, "weights"] for frame in (5, 6, 7)]
    np.testing.assert_allclose(weights[1], (weights[0] + weights[2]) / 2, atol=1e-5)
    monkeypatch.setattr(SkinnedSurface, "canonical_vertices", lambda self, pose: sometimes(self, bad))
    with pytest.raises(UserError, match="no frame has a shape that can be followed"):
        export_character(toy, tmp_path / "none.glb", [Clip(wave(2))], FEW)
    assert not (tmp_path / "none.glb").exists()


def test_whole_or_not_at_all(toy, tmp_path, monkeypatch):
    path = tmp_path / "worm.glb"

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(character_glb, "_add_clip", fail)
    with pytest.raises(OSError, match="No space"):
        export_character(toy, path, [Clip(wave(2))], FEW)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    path.write_bytes(b"mine")
    with pytest.raises(UserError, match=r"worm.glb exists already; give overwrite=true"):
        export_character(toy, path, [Clip(wave(2))], FEW)
    assert path.read_bytes() == b"mine"
    export_character(toy, path, [Clip(wave(2))], FEW, overwrite=True)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes()[:4] == b"glTF"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"influences": 3}, "influences: wanted 4 or 8, got 3"),
        ({"triangles": 5}, "triangles: wanted 100 to 5000000, got 5"),
        ({"triangles": 10**8}, "triangles: wanted 100 to"),
        ({"morph_targets": -1}, "morph_targets: wanted 0 to 64, got -1"),
        ({"resolution": 4}, "resolution: wanted 16 to 1024, got 4"),
    ],
)
def test_what_can_be_wrong(toy, tmp_path, change, message):
    with pytest.raises(UserError, match=message):
        export_character(toy, tmp_path / "worm.glb", [Clip(wave(2))], replace(FEW, **change))
    assert list(tmp_path.iterdir()) == []


def test_without_weights_or_motions_there_is_no_character(toy, tmp_path, monkeypatch):
    with pytest.raises(UserError, match="clips: wanted at least one motion to export, got none"):
        export_character(toy, tmp_path / "worm.glb", [], FEW)
    monkeypatch.setattr(ToyCharacter, "has_skinning_weights", False)
    with pytest.raises(
        UserError, match="a rig needs skinning weights of canonical points, which model fast_snarf does not have"
    ):
        export_character(toy, tmp_path / "worm.glb", [Clip(wave(2))], FEW)


def test_a_shape_without_condition_is_looked_for_once(tmp_path, monkeypatch):
    toy = ToyCharacter(bulge=0.0)
    follow, calls = SkinnedSurface.shape_in, []
    monkeypatch.setattr(SkinnedSurface, "shape_in", lambda self, pose: calls.append(0) or follow(self, pose))
    counts, files = [], []
    for name in ("global", "none"):
        toy.config.condition.name = name
        export_character(toy, tmp_path / f"{name}.glb", [Clip(wave(5))], FEW, name="worm")
        surface = character_surface(toy, FEW)
        clip = Clip(wave(5))
        written = GlbReader(tmp_path / f"{name}.glb").vertices("wave", 3 / FRAME_RATE)
        files.append([written, posed(surface, clip, 3), posed(surface, clip, 4)])
        counts.append(len(calls))
        calls.clear()
    assert counts == [7, 2]
    for conditioned, fixed in zip(*files, strict=True):
        np.testing.assert_allclose(fixed, conditioned, atol=1e-6)
