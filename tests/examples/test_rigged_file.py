"""The example with a rigged file: the rig is sound, and comes back as a rigged file of a trained avatar."""

from __future__ import annotations

import json

import numpy as np
import rigged_file
import trimesh

from snarfcli.formats.gltf import read_gltf


def test_the_tail_is_closed_and_its_weights_sum_to_one():
    vertices, faces = rigged_file.surface()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0.02
    np.testing.assert_allclose(rigged_file.weights(vertices).sum(1), 1, atol=1e-9)


def test_a_rigged_file_comes_back_as_an_avatar(tmp_path):
    character = rigged_file.run(tmp_path, steps=100, frame_step=20)
    facts = json.loads((tmp_path / "outputs/meshes/tail/tail/eval_id/metrics.json").read_text())
    assert facts["iou_bbox"] > 0.85
    rig = read_gltf(character)
    assert rig.names == tuple(f"tail_{joint}" for joint in range(rigged_file.JOINTS))
    assert [len(clip.world_from_joint) for clip in rig.clips] == [rigged_file.FRAMES]
    rest = rig.rest[:, :3, 3]
    np.testing.assert_allclose(np.diff(rest, axis=0), np.tile([0, rigged_file.LENGTH, 0], (4, 1)), atol=1e-5)
    (mesh,) = trimesh.load(character).geometry.values()
    assert len(mesh.faces) <= 4000
    height = np.ptp(mesh.vertices[:, 1])
    assert abs(height - rigged_file.JOINTS * rigged_file.LENGTH) < 0.1
