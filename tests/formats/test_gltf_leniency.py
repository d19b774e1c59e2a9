"""glTF files that bend the rules, or use parts of them that few readers know: what viewers show is read."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from toy_gltf import BOX, GltfBuilder, two_bones

from snarfcli.errors import UserError
from snarfcli.formats.gltf import read_gltf, read_gltf_surface
from snarfcli.formats.rig import Rig


def read(tmp_path, builder: GltfBuilder, reader=read_gltf):
    path = tmp_path / "file.glb"
    path.write_bytes(builder.glb())
    return reader(path)


def same(rig: Rig, other: Rig) -> None:
    np.testing.assert_array_equal(rig.rest, other.rest)
    np.testing.assert_array_equal(rig.mesh.vertices, other.mesh.vertices)
    np.testing.assert_array_equal(rig.mesh.faces, other.mesh.faces)
    np.testing.assert_array_equal(rig.mesh.weights, other.mesh.weights)
    np.testing.assert_array_equal(rig.clips[-1].world_from_joint, other.clips[-1].world_from_joint)


# ---------------------------------------------------------------- scenes
@pytest.mark.parametrize("named", [[0, 4], [4], [0, 4, 5], [4, 4]])
def test_a_scene_may_name_nodes_that_have_a_parent(tmp_path, named):
    builder = two_bones()
    builder.root["nodes"].append({"name": "above", "children": [0, 4]})
    builder.root["scenes"] = [{"nodes": named}]
    same(read(tmp_path, builder), read(tmp_path, two_bones()))
    assert len(read(tmp_path, builder, read_gltf_surface)[1]) == 12  # and not twice


def test_a_named_child_keeps_its_place_in_the_world(tmp_path):
    builder = GltfBuilder()
    primitive = {"attributes": {"POSITION": builder.array(BOX.vertices)}, "indices": builder.array(BOX.faces.ravel(), "uint8")}
    builder.root.update(
        nodes=[
            {"translation": [0, 3, 0], "children": [1]},
            {"mesh": 0, "children": [2]},
            {"mesh": 0, "translation": [1, 0, 0]},
        ],
        meshes=[{"primitives": [primitive]}],
        scenes=[{"nodes": [1]}],
    )
    vertices, faces = read(tmp_path, builder, read_gltf_surface)
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [[-0.1, 2.5, -0.1], [1.1, 3.5, 0.1]], atol=1e-6)
    builder.root["scenes"] = [{"nodes": [2]}]
    assert read(tmp_path, builder, read_gltf_surface)[0][:, 0].min() == pytest.approx(0.9)
    assert len(faces) == 24


# ---------------------------------------------------------------- clips
def clip_of(builder: GltfBuilder, name: str, values, path: str = "rotation", node: int = 3) -> dict:
    sampler = {"input": builder.array(np.arange(len(values)) / 30), "output": builder.array(values)}
    return {"name": name, "samplers": [sampler], "channels": [{"sampler": 0, "target": {"node": node, "path": path}}]}


def with_clips(*clips) -> GltfBuilder:
    """Two bones with these clips (name, values, path, node), and one called fine."""
    builder = two_bones()
    turns = Rotation.from_euler("x", [[0], [30], [60]], degrees=True).as_quat()
    builder.root["animations"] = [clip_of(builder, *clip) for clip in clips] + [clip_of(builder, "fine", turns)]
    return builder


@pytest.mark.parametrize(
    ("values", "path", "reason"),
    [
        ([[0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 1]], "rotation", "zero quaternion"),
        ([[0, 0, 0], [np.nan, 0, 0], [0, 0, 0]], "translation", "NaN"),
        ([[1, 1, 1], [1e20, 1, 1], [1, 1, 1]], "scale", "scale zero or too large numbers in clip bad"),
        ([[0, 0, 0, 1]] * 2, "translation", "wanted VEC3"),
    ],
)
def test_one_damaged_clip_leaves_the_others(tmp_path, caplog, values, path, reason):
    caplog.set_level("INFO", logger="snarfcli")
    rig = read(tmp_path, with_clips(("bad", values, path)))
    assert [clip.name for clip in rig.clips] == ["fine"]
    same(rig, read(tmp_path, with_clips()))
    assert [name for name, _ in rig.left_out] == ["bad"]
    assert reason in rig.left_out[0][1]
    assert "left out 1 motion that cannot be used ('bad': " in caplog.text
    alone = with_clips(("bad", values, path))
    alone.root["animations"].pop()
    with pytest.raises(UserError, match=reason):
        read(tmp_path, alone)


def test_a_clip_of_nodes_that_are_missing_leaves_the_others(tmp_path):
    for damage in ({"node": 99}, {"node": -1}, {"node": "3"}):
        builder = with_clips(("bad", [[0, 0, 0, 1]] * 3))
        builder.root["animations"][0]["channels"][0]["target"].update(damage)
        rig = read(tmp_path, builder)
        assert [clip.name for clip in rig.clips] == ["fine"]
        assert "there are 5 nodes" in rig.left_out[0][1]


@pytest.mark.parametrize(("node", "hidden"), [(3, [1]), (1, [0, 1])])
def test_a_joint_hidden_by_scale_zero_keeps_its_direction(tmp_path, node, hidden):
    """The joints that hang on it shrink to its place, and keep their directions as well."""
    builder = with_clips(("hide", [[1, 1, 1], [0, 0, 0], [1, 1, 1]], "scale", node))
    hide = builder.root["animations"][0]
    turns = builder.array(Rotation.from_euler("x", [[0], [30], [60]], degrees=True).as_quat())
    hide["samplers"].append({"input": hide["samplers"][0]["input"], "output": turns})
    hide["channels"].append({"sampler": 1, "target": {"node": 3, "path": "rotation"}})
    rig = read(tmp_path, builder)
    assert [clip.name for clip in rig.clips] == ["hide", "fine"]
    assert not rig.left_out
    clip, same_turns = (clip.world_from_joint for clip in rig.clips)
    size = np.cbrt(np.linalg.det(clip[..., :3, :3] @ np.linalg.inv(rig.rest[:, :3, :3])))
    np.testing.assert_allclose(size[:, hidden], np.tile([[1], [1e-4], [1]], len(hidden)), rtol=1e-5)
    directions = clip[..., :3, :3] / size[..., None, None]
    np.testing.assert_allclose(directions, same_turns[..., :3, :3], atol=1e-6)
    np.testing.assert_array_equal(clip[[0, 2]], same_turns[[0, 2]])


def test_a_joint_hidden_while_no_clip_plays_does_not_refuse_the_file(tmp_path):
    builder = with_clips(("show", [[0, 0, 0], [1, 1, 1]], "scale"))
    builder.root["nodes"][3]["scale"] = [0, 0, 0]
    rig = read(tmp_path, builder)
    same_rest = read(tmp_path, with_clips())
    np.testing.assert_allclose(rig.rest, same_rest.rest, atol=1e-6)  # the skin says where it is
    np.testing.assert_allclose(rig.mesh.vertices, same_rest.mesh.vertices, atol=1e-6)
    shown = rig.clips[0].world_from_joint[1] @ np.linalg.inv(rig.rest)
    np.testing.assert_allclose(shown, np.tile(np.eye(4), (2, 1, 1)), atol=1e-5)


# ---------------------------------------------------------------- influences
@pytest.mark.parametrize("sets", [1, 2, 3, 5])
def test_all_sets_of_influences_count(tmp_path, sets):
    builder = two_bones()
    random = np.random.default_rng(sets)
    weights = random.random((8, sets, 4))
    joints = random.integers(0, 2, (8, sets, 4))
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    for number in range(sets):
        attributes[f"JOINTS_{number}"] = builder.array(joints[:, number], "uint8")
        attributes[f"WEIGHTS_{number}"] = builder.array(weights[:, number])
    attributes[f"WEIGHTS_{sets}"] = builder.array(np.ones((8, 4)))  # without its joints
    second = (weights * joints).sum((1, 2)) / weights.sum((1, 2))
    got = read(tmp_path, builder).mesh.weights  # joint 0 of the skin is the second of the rig
    np.testing.assert_allclose(got, np.stack([second, 1 - second], 1), atol=1e-6)


def test_too_many_influences_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("snarfcli.formats.gltf_mesh._MAX_INFLUENCES", 8 * 12)
    builder = two_bones()
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    for number in range(4):
        attributes |= {f"JOINTS_{number}": attributes["JOINTS_0"], f"WEIGHTS_{number}": attributes["WEIGHTS_0"]}
    with pytest.raises(UserError, match="8 vertices follow up to 16 joints each, which is too many"):
        read(tmp_path, builder)


# ---------------------------------------------------------------- compression with plain values beside it
def compressed(builder: GltfBuilder, view: int, name: str = "EXT_meshopt_compression") -> GltfBuilder:
    """Say that a buffer view is compressed as well; its plain values stay."""
    where = {
        "buffer": 0,
        "byteOffset": len(builder.binary),
        "byteLength": 16,
        "byteStride": 12,
        "count": 8,
        "mode": "ATTRIBUTES",
    }
    builder.binary.extend(b"\xa0" * 16)
    builder.root["bufferViews"][view]["extensions"] = {name: where}
    builder.root["extensionsUsed"] = [name]
    return builder


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
@pytest.mark.parametrize("view", range(5))
def test_meshopt_with_plain_values_is_read(tmp_path, name, view):
    builder = compressed(two_bones(), view, name)
    same(read(tmp_path, builder), read(tmp_path, two_bones()))
    (tmp_path / "text.gltf").write_bytes(builder.gltf())
    same(read_gltf(tmp_path / "text.gltf"), read(tmp_path, two_bones()))
    builder.root["extensionsRequired"] = [name]
    with pytest.raises(UserError, match="is compressed with meshopt, which is not supported"):
        read(tmp_path, builder)


def test_meshopt_without_plain_values_is_refused(tmp_path):
    import json

    builder = compressed(two_bones(), 0)
    content = json.loads(builder.gltf())
    content["bufferViews"][0]["buffer"] = 1
    content["buffers"].append({"byteLength": 500, "extensions": {"EXT_meshopt_compression": {"fallback": True}}})
    (tmp_path / "text.gltf").write_text(json.dumps(content))
    with pytest.raises(UserError, match="is compressed with meshopt, which is not supported"):
        read_gltf(tmp_path / "text.gltf")
    builder.root["bufferViews"][0]["extensions"]["EXT_meshopt_compression"]["byteOffset"] = 0  # where the values should be
    with pytest.raises(UserError, match="is compressed with meshopt, which is not supported"):
        read(tmp_path, builder)


@pytest.mark.parametrize("emptied", [None, "POSITION", "JOINTS_0", "WEIGHTS_0", "indices"])
def test_draco_is_read_where_all_values_are_there_without_it(tmp_path, emptied):
    builder = two_bones()
    primitive = builder.root["meshes"][0]["primitives"][0]
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    builder.root["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    if emptied is None:
        same(read(tmp_path, builder), read(tmp_path, two_bones()))
        return
    number = primitive["indices"] if emptied == "indices" else primitive["attributes"][emptied]
    del builder.root["accessors"][number]["bufferView"]
    with pytest.raises(UserError, match="is compressed with Draco, which is not supported"):
        read(tmp_path, builder)


def test_quantised_positions_need_no_decompression(tmp_path):
    """KHR_mesh_quantization: integers, which the node or, for skins, the inverse bind matrices scale."""
    builder = GltfBuilder(extensionsUsed=["KHR_mesh_quantization"], extensionsRequired=["KHR_mesh_quantization"])
    corners = builder.array(np.round(BOX.vertices * 1000), "int16")
    normalised = builder.array(np.round(BOX.vertices * 32767), "int16", normalized=True)
    indices = builder.array(BOX.faces.ravel(), "uint8")
    builder.root.update(
        nodes=[{"mesh": 0, "scale": [0.001] * 3}, {"mesh": 1, "translation": [2, 0, 0]}],
        meshes=[{"primitives": [{"attributes": {"POSITION": at}, "indices": indices}]} for at in (corners, normalised)],
    )
    vertices, faces = read(tmp_path, builder, read_gltf_surface)
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [[-0.1, -0.5, -0.1], [2.1, 0.5, 0.1]], atol=1e-4)
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(0.08, rel=1e-3)
