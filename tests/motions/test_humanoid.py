"""VRM: the file's own table of bones pairs the joints, whatever they are called."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_rigs import a_pose, rig_of
from toy_vrm import VRM_BONES, human_vrm

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.errors import UserError
from snarfcli.formats.gltf import read_gltf
from snarfcli.motions import read_motion

TABLES = ("VRMC_vrm", "VRMC_vrm_animation", "VRM")


@pytest.fixture(scope="module")
def walk() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    poses = a_pose() + random.normal(0, 0.15, (6, 24, 3))
    return poses, np.linspace([0, 0, 0], [0, 0, 0.5], 6)


def world_rotations(poses: np.ndarray) -> np.ndarray:
    from snarfcli.motions.anatomy import joint_positions

    return joint_positions(poses, np.zeros((len(poses), 3)))[1]


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("with_mesh", [True, False])
def test_the_table_pairs_joints_without_telling_names(tmp_path, walk, table, with_mesh):
    poses, translation = walk
    path = tmp_path / ("a.vrma" if table == "VRMC_vrm_animation" else "a.VRM")
    path.write_bytes(human_vrm(rig_of(poses, translation), table, with_mesh=with_mesh).glb())
    rig = read_gltf(path)
    assert len(rig.names) == 24  # the node of an expression is no joint
    names = {bone: f"thing.{7 * SMPL_JOINT_NAMES.index(part) % 24}" for bone, part in VRM_BONES.items()}
    assert {bone: rig.names[joint] for bone, joint in rig.humanoid.items()} == names
    motion = read_motion(path)
    np.testing.assert_allclose(world_rotations(motion.poses), world_rotations(poses), atol=1e-5)
    np.testing.assert_allclose(motion.translation - motion.translation[0], translation, atol=1e-5)


def test_a_body_of_vrm_0_that_faces_backwards_is_turned(tmp_path, walk):
    poses, translation = walk
    about = Rotation.from_euler("y", 180, degrees=True)
    (tmp_path / "a.vrm").write_bytes(human_vrm(rig_of(poses, translation, world=about), "VRM").glb())
    motion = read_motion(tmp_path / "a.vrm")
    turned = about.as_matrix() @ world_rotations(poses)
    np.testing.assert_allclose(world_rotations(motion.poses), turned, atol=1e-5)


def test_a_character_without_motion_says_so(tmp_path, walk):
    builder = human_vrm(rig_of(*walk), "VRMC_vrm")
    builder.root["animations"] = []
    (tmp_path / "a.vrm").write_bytes(builder.glb())
    with pytest.raises(UserError, match=r"a\.vrm has no motion; export it with its animation"):
        read_motion(tmp_path / "a.vrm")


@pytest.mark.parametrize(
    "damage",
    [None, [], 3, {"humanoid": 3}, {"humanoid": {"humanBones": {"hips": {"node": 10**9}, "head": 7, "neck": {"node": "1"}}}},
     {"humanoid": {"humanBones": [3, {"bone": 7, "node": 1}, {"node": 2}, {"bone": "x" * 999, "node": 1}]}}],
)  # fmt: skip
def test_damaged_tables_are_no_tables(tmp_path, walk, damage):
    builder = human_vrm(rig_of(*walk), "VRM")
    builder.root["extensions"]["VRM"] = damage
    (tmp_path / "a.vrm").write_bytes(builder.glb())
    assert not read_gltf(tmp_path / "a.vrm").humanoid


def test_thumbs_of_both_versions_are_the_same_bones(tmp_path, walk):
    """VRM 0 begins with the proximal bone, VRM 1.0 with the metacarpal: the same joint."""
    for table, names in (("VRM", ("Proximal", "Intermediate")), ("VRMC_vrm", ("Metacarpal", "Proximal"))):
        builder = human_vrm(rig_of(*walk), table)
        bones = builder.root["extensions"][table]["humanoid"]["humanBones"]
        content = json.loads(json.dumps(bones))
        for name, node in zip(names, (5, 6), strict=True):
            if table == "VRM":
                content = [entry for entry in content if entry["node"] != node] + [{"bone": f"leftThumb{name}", "node": node}]
            else:
                content = {bone: entry for bone, entry in content.items() if entry["node"] != node}
                content[f"leftThumb{name}"] = {"node": node}
        builder.root["extensions"][table]["humanoid"]["humanBones"] = content
        (tmp_path / "a.vrm").write_bytes(builder.glb())
        rig = read_gltf(tmp_path / "a.vrm")
        joints = [rig.names[rig.humanoid[f"leftThumb{name}"]] for name in ("Metacarpal", "Proximal")]
        assert joints == [builder.root["nodes"][node]["name"] for node in (5, 6)]
