"""VRM models and animations, as the Khronos validator, three-vrm and our own reader see them."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from glb_reader import READERS, GlbReader, needs_readers, run_reader
from scipy.spatial.transform import Rotation
from toy_character import ToyCharacter, wave
from toy_human import ToyHuman

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.export.character import CharacterOptions
from snarfcli.export.character_surface import character_surface
from snarfcli.export.clips import Clip
from snarfcli.export.export import ExportReport
from snarfcli.export.human_bones import human_bones
from snarfcli.export.vrm import export_vrm
from snarfcli.export.vrm_meta import VrmMeta, check_meta, meta_object
from snarfcli.export.vrma import export_vrma
from snarfcli.formats.gltf import read_gltf
from snarfcli.motions import Motion, builtin_motion, read_motion

REQUIRED = (
    "hips", "spine", "head", "leftUpperLeg", "leftLowerLeg", "leftFoot", "rightUpperLeg", "rightLowerLeg", "rightFoot",
    "leftUpperArm", "leftLowerArm", "leftHand", "rightUpperArm", "rightLowerArm", "rightHand",
)  # fmt: skip
OPTIONS = CharacterOptions(triangles=2000, resolution=48)
RATE = 10.0
needs_vrm = pytest.mark.skipif(
    not (READERS / "node_modules" / "@pixiv" / "three-vrm").is_dir(),
    reason="wants three-vrm in build/readers, where tools/set_up.sh puts it",
)


def punching() -> Motion:
    """Return a motion of the toy that stands on y = 0, as exported motions do."""
    motion = builtin_motion("punching", 0, frame_rate=RATE).slice(stop=8)
    return replace(motion, translation=np.add(motion.translation, [0.2, 1.22, 0.1]))


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> tuple[Path, Path, ExportReport, ToyHuman]:
    folder, toy = tmp_path_factory.mktemp("vrm"), ToyHuman()
    files = [folder / "toy.vrma"]
    report = export_vrm(toy, folder / "toy.vrm", [Clip(punching())], OPTIONS, clip_files=files)
    return folder / "toy.vrm", files[0], report, toy


@pytest.fixture(scope="module")
def reader(exported) -> GlbReader:
    copy = exported[0].with_suffix(".glb")
    shutil.copy(exported[0], copy)
    return GlbReader(copy)


@pytest.fixture(scope="module")
def seen(exported) -> dict:
    """What three-vrm makes of both files."""
    times = [frame / RATE for frame in (0, 3, 7)]
    return run_reader("vrm.mjs", exported[0], "leftUpperArm", -0.9, "shape_0", exported[1], *times)


def extension(reader: GlbReader) -> dict:
    return reader.gltf.extensions["VRMC_vrm"]


def test_the_model_has_every_required_bone_and_no_clip(exported, reader):
    bones = extension(reader)["humanoid"]["humanBones"]
    assert set(REQUIRED) <= set(bones)
    optional = {"chest", "upperChest", "neck", "leftShoulder", "rightShoulder", "leftToes", "rightToes"}
    assert set(bones) - set(REQUIRED) == optional | {"leftMiddleProximal", "rightMiddleProximal"}
    names = {bone: reader.gltf.nodes[entry["node"]].name for bone, entry in bones.items()}
    assert (names["hips"], names["upperChest"], names["leftFoot"]) == ("pelvis", "spine3", "l_ankle")
    assert reader.gltf.extensionsUsed == ["VRMC_vrm"]
    assert not reader.gltf.animations
    assert extension(reader)["specVersion"] == "1.0"
    assert exported[2].num_bytes == exported[0].stat().st_size


def test_the_stored_mesh_is_in_t_pose_on_the_ground(reader):
    vertices, bones = reader.attribute("POSITION"), extension(reader)["humanoid"]["humanBones"]
    assert vertices[:, 1].min() == pytest.approx(0, abs=1e-6)
    bind = np.linalg.inv(reader.array(reader.skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1))
    nodes = np.stack([reader._world(joint, {}, {}) for joint in reader.skin.joints])
    np.testing.assert_allclose(nodes, bind, atol=1e-6)
    np.testing.assert_allclose(bind[:, :3, :3], np.tile(np.eye(3), (24, 1, 1)), atol=1e-6)
    places = {bone: bind[reader.skin.joints.index(entry["node"]), :3, 3] for bone, entry in bones.items()}
    arm = places["leftHand"] - places["leftUpperArm"]
    np.testing.assert_allclose(arm / np.linalg.norm(arm), [1, 0, 0], atol=1e-6)
    reach = np.ptp(vertices[np.abs(vertices[:, 0]) > 0.5], axis=0)[1:]
    np.testing.assert_allclose(reach, 0.12, atol=0.02)  # hands and forearms are level: as thin as the capsule
    below = vertices[vertices[:, 1] < 0.5]
    assert np.abs(below[:, 0]).max() < 0.11 + 0.07  # the legs hang straight down, not 30 degrees apart


def test_shapes_are_custom_expressions_around_the_mean(exported, reader):
    custom = extension(reader)["expressions"]["custom"]
    assert list(custom) == reader.mesh.extras["targetNames"]
    assert len(custom) == exported[2].morph_targets > 0
    for number, expression in enumerate(custom.values()):
        assert expression["morphTargetBinds"] == [{"node": reader.mesh_node, "index": number, "weight": 1.0}]
    assert not any(reader.mesh.weights)


def test_the_deviation_is_small_and_printed(exported):
    report = exported[2]
    # The legs are 30 degrees from the canonical pose; a fit of the stored shape leaves a millimetre of it.
    assert report.deviation_mm["rms_mm"] < 0.3
    assert report.deviation_mm["max_mm"] < 3
    assert report.morph_share > 0.99


@needs_readers
def test_the_validator_finds_nothing(exported):
    for file in exported[:2]:
        issues = run_reader("validate.mjs", file)["issues"]
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
        assert {message["code"] for message in issues["messages"]} <= {"UNSUPPORTED_EXTENSION", "NODE_EMPTY"}


@needs_vrm
def test_three_vrm_finds_the_bones_in_t_pose(seen, reader):
    assert set(REQUIRED) <= set(seen["places"])
    places = {bone: np.array(place) for bone, place in seen["places"].items()}
    for side, sign in (("left", 1), ("right", -1)):
        for start, end in (("UpperArm", "LowerArm"), ("LowerArm", "Hand")):
            bone = places[side + end] - places[side + start]
            np.testing.assert_allclose(bone / np.linalg.norm(bone), [sign, 0, 0], atol=1e-6)
    for bone in ("leftUpperArm", "rightLowerArm", "leftUpperLeg"):
        np.testing.assert_allclose(seen["normalized"][bone]["rotation"], [0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(seen["rest"], reader.attribute("POSITION"), atol=1e-5)
    assert seen["expressions"] == list(extension(reader)["expressions"]["custom"])


@needs_vrm
def test_a_turned_bone_moves_the_skin_as_linear_blend_skinning_does(seen, reader):
    node = extension(reader)["humanoid"]["humanBones"]["leftUpperArm"]["node"]
    bind = np.linalg.inv(reader.array(reader.skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1))
    joint = bind[reader.skin.joints.index(node), :3, 3]
    turn = Rotation.from_euler("z", -0.9).as_matrix()
    moves = np.tile(np.eye(4), (24, 1, 1))
    for number, member in enumerate(reader.skin.joints):
        while member is not None and member != node:
            member = reader.parents.get(member)
        if member == node:
            moves[number, :3, :3], moves[number, :3, 3] = turn, joint - turn @ joint
    blended = np.einsum("vj,jab->vab", reader.dense_weights(), moves)
    vertices = reader.attribute("POSITION")
    wanted = np.einsum("vab,vb->va", blended[:, :3, :3], vertices) + blended[:, :3, 3]
    assert np.abs(wanted - vertices).max() > 0.3
    np.testing.assert_allclose(seen["turned"], wanted, atol=1e-5)


@needs_vrm
def test_an_expression_moves_the_shape(seen, reader):
    (first, *_) = reader.primitive.targets
    np.testing.assert_allclose(seen["shaped"], reader.attribute("POSITION") + reader.array(first["POSITION"]), atol=1e-5)


@needs_vrm
def test_the_motion_plays_as_the_avatar_moves(seen, exported):
    _, _, report, toy = exported
    surface, motion = character_surface(toy, OPTIONS), punching()
    for frame, vertices in zip((0, 3, 7), seen["frames"], strict=True):
        pose, translation = (torch.from_numpy(part[frame]).float() for part in (motion.poses, motion.translation))
        error = np.linalg.norm(np.array(vertices) - surface.posed(pose, translation).vertices, axis=1).max()
        assert error < 1e-3 * report.deviation_mm["max_mm"] + 1e-4


def test_our_reader_sees_the_same_skeleton_and_motion(exported, tmp_path):
    toy, copy = exported[3], tmp_path / "toy.glb"
    shutil.copy(exported[0], copy)
    rig = read_gltf(copy)
    assert rig.names == toy.skeleton.names
    assert rig.parents == toy.skeleton.parents
    shutil.copy(exported[1], copy)  # bones under the names of VRM
    hands = {"l_hand": "leftMiddleProximal", "r_hand": "rightMiddleProximal"}
    back, motion = read_motion(copy, toy.skeleton, mapping=hands), punching()
    np.testing.assert_allclose(back.poses, motion.poses, atol=2e-5)
    np.testing.assert_allclose(back.translation, motion.translation, atol=2e-5)


def test_the_conditions_of_use_are_cautious_and_settable(reader):
    meta = extension(reader)["meta"]
    assert meta == {
        "name": "toy",
        "authors": ["unknown"],
        "licenseUrl": "https://vrm.dev/licenses/1.0/",
        "allowExcessivelyViolentUsage": False,
        "allowExcessivelySexualUsage": False,
        "allowPoliticalOrReligiousUsage": False,
        "allowAntisocialOrHateUsage": False,
        "allowRedistribution": False,
        "avatarPermission": "onlyAuthor",
        "commercialUsage": "personalNonProfit",
        "creditNotation": "required",
        "modification": "prohibited",
    }
    given = VrmMeta(name="Anna", version="2", authors=["me"], copyright="mine", references=["SMPL"], redistribution=True,
                    avatar_permission="everyone")  # fmt: skip
    check_meta(given)
    found = meta_object(given, "toy")
    assert (found["name"], found["version"], found["copyrightInformation"]) == ("Anna", "2", "mine")
    assert (found["authors"], found["references"]) == (["me"], ["SMPL"])
    assert found["allowRedistribution"]
    assert found["avatarPermission"] == "everyone"
    assert "contactInformation" not in found
    for change, message in (
        ({"modification": "yes"}, "vrm.modification: wanted prohibited, allowModification or"),
        ({"credit_notation": "none"}, "vrm.credit_notation: wanted required or unnecessary, got 'none'"),
        ({"authors": ["me", " "]}, "vrm.authors: wanted names, got an empty one"),
    ):
        with pytest.raises(UserError, match=message):
            check_meta(replace(given, **change))


def test_a_motion_alone(tmp_path):
    toy, path = ToyHuman(), tmp_path / "a.vrma"
    size = export_vrma(path, Clip(punching()), toy.skeleton)
    assert size == path.stat().st_size
    shutil.copy(path, tmp_path / "a.glb")
    text = (tmp_path / "a.glb").read_bytes()
    root = json.loads(text[20 : 20 + int.from_bytes(text[12:16], "little")])
    assert root["extensions"]["VRMC_vrm_animation"]["specVersion"] == "1.0"
    assert "expressions" not in root["extensions"]["VRMC_vrm_animation"]
    moved = [channel["target"] for channel in root["animations"][0]["channels"] if channel["target"]["path"] == "translation"]
    assert [root["nodes"][target["node"]]["name"] for target in moved] == ["hips"]
    assert root["nodes"][moved[0]["node"]]["translation"][1] == pytest.approx(0.993 - 0.059, abs=0.01)  # above the toes
    with pytest.raises(UserError, match=r"a.vrma exists already"):
        export_vrma(path, Clip(punching()), toy.skeleton)


def test_what_is_no_human_is_a_line(tmp_path):
    with pytest.raises(UserError) as caught:
        export_vrm(ToyCharacter(), tmp_path / "worm.vrm", [Clip(wave(2))], OPTIONS)
    message = (
        "format=vrm: wanted the skeleton of a human, got one without pelvis, l_hip, l_knee, l_ankle, l_shoulder, l_elbow and"
    )
    assert str(caught.value).startswith(message)
    assert str(caught.value).endswith("give format=glb, which takes any skeleton")
    skeleton = ToyHuman().skeleton
    names, parents = skeleton.names, list(skeleton.parents)
    parents[names.index("l_elbow")] = names.index("neck")
    wrong = Skeleton(names, tuple(parents), skeleton.joints_rest, skeleton.canonical_pose)
    with pytest.raises(
        UserError, match=re.escape("wanted l_elbow (leftLowerArm) below l_shoulder (leftUpperArm), got it below")
    ):
        human_bones(wrong)
    with pytest.raises(UserError, match="clips: wanted at least one motion that shows the shape"):
        export_vrm(ToyHuman(), tmp_path / "a.vrm", [], OPTIONS)
    assert list(tmp_path.iterdir()) == []
