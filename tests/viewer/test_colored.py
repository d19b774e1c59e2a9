from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh

from snarfcli.viewer.colored import colored_glb


@pytest.mark.parametrize("opacity", [1.0, 0.4])
def test_another_reader_finds_the_mesh_and_its_colours(opacity):
    ball = trimesh.creation.icosphere(subdivisions=1)
    colors = np.random.default_rng(0).integers(0, 256, (len(ball.vertices), 3)).astype(np.uint8)
    data = colored_glb(ball.vertices.astype(np.float32), ball.faces.astype(np.int32), colors, opacity)
    assert len(data) % 4 == 0
    mesh = trimesh.load(io.BytesIO(data), file_type="glb", process=False).to_geometry()
    np.testing.assert_allclose(mesh.vertices, ball.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, ball.faces)
    assert f'"alphaMode":"{"OPAQUE" if opacity == 1 else "BLEND"}"'.encode() in data


def test_colours_are_linear():
    corners, faces = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.int32)
    data = colored_glb(corners, faces, np.array([[0, 128, 255]] * 3, dtype=np.uint8))
    rgba = np.frombuffer(data[-12 - 24 : -12], "<u2").reshape(3, 4) / 65535
    # sRGB 128/255 is 0.2159 of the light (IEC 61966-2-1)
    np.testing.assert_allclose(rgba[0], [0, 0.2159, 1, 1], atol=1e-3)
