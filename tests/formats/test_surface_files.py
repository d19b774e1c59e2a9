from __future__ import annotations

import struct

import numpy as np
import pytest
import trimesh
from toy_animal import animal_motion, make_animal
from toy_animal_files import animal_glb, write_mesh

from snarfcli.errors import UserError
from snarfcli.formats.surfaces import SURFACE_SUFFIXES, list_surfaces, read_surface

_BALL = trimesh.creation.icosphere(2)
_TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"


def _is_closed(surface):
    return trimesh.Trimesh(*surface, process=False).is_watertight


def _write(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".obj", {}),
        (".off", {"digits": 17}),
        (".ply", {}),
        (".ply", {"encoding": "ascii"}),
        (".stl", {}),
        (".stl", {"file_type": "stl_ascii"}),
        (".glb", {}),
    ],
)
def test_what_trimesh_writes_is_read_as_trimesh_reads_it(suffix, options, tmp_path):
    path = _write(tmp_path, f"ball{suffix}", _BALL.export(**{"file_type": suffix[1:], **options}))
    vertices, faces = read_surface(path)
    assert (vertices.dtype, faces.dtype) == (np.float64, np.int64)
    theirs = trimesh.load(path, force="mesh", process=False)
    # trimesh rounds the text of PLY files to float32
    np.testing.assert_allclose(vertices[faces], theirs.vertices[theirs.faces], atol=1e-7)
    assert vertices.shape == _BALL.vertices.shape
    assert _is_closed((vertices, faces))
    if suffix not in (".stl", ".glb"):  # of the others the order is kept
        np.testing.assert_allclose(vertices, _BALL.vertices, atol=1e-6)
        np.testing.assert_array_equal(faces, _BALL.faces)
    upper = path.with_name(f"BALL2{suffix.upper()}")
    path.rename(upper)
    assert read_surface(upper)[0].shape == vertices.shape


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_posed_animals_keep_their_order(suffix, tmp_path):
    animal = make_animal(0.05)
    posed = animal.posed(animal_motion("sit", 3))[1]
    write_mesh(tmp_path / f"frame{suffix}", posed, animal.faces)
    vertices, faces = read_surface(tmp_path / f"frame{suffix}")
    np.testing.assert_allclose(vertices, posed, atol=1e-7)
    np.testing.assert_array_equal(faces, animal.faces)


def test_rigged_animal_is_read_as_it_stands(tmp_path):
    animal = make_animal(0.05)
    path = _write(tmp_path, "animal.glb", animal_glb(animal, [animal_motion("walk", 3)]))
    vertices, faces = read_surface(path)
    np.testing.assert_allclose(vertices, animal.vertices, atol=1e-6)
    assert _is_closed((vertices, faces))


def test_obj_by_its_vertex_lines(tmp_path):
    """Texture seams, normals, colours, relative numbers, quads, comments, broken lines and several objects."""
    text = (
        "# made by hand\nmtllib secret.mtl\no one\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nusemtl x\n"
        "f 1/1/1 2/1/1 \\\n3/1/1 4//1 # a square\no two\nv 0 0 1\nv 1 0 1\nv 1 1 1\nf -3 -2 -1\nl 1 2\n"
    )
    vertices, faces = read_surface(_write(tmp_path, "a.obj", text.replace("\n", "\r\n")))
    np.testing.assert_array_equal(vertices[:4], [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    assert len(read_surface(_write(tmp_path, "mac.obj", text.replace("\\\n", "").replace("\n", "\r")))[1]) == 3


def test_other_files_are_not_opened(tmp_path, monkeypatch):
    opened = []
    original = type(tmp_path).read_bytes
    monkeypatch.setattr(type(tmp_path), "read_bytes", lambda path: (opened.append(path.name), original(path))[1])
    (tmp_path / "secret.mtl").write_text("newmtl x\nmap_Kd secret.png\n")
    body = b"mtllib secret.mtl\nusemtl x\n" + _TETRAHEDRON + b"f 1 2 3\n"
    read_surface(_write(tmp_path, "a.obj", body))
    header = "ply\nformat ascii 1.0\ncomment TextureFile secret.png\nelement vertex 3\nproperty float x\nproperty float y\n"
    header += "property float z\nelement face 1\nproperty list uchar int vertex_index\nend_header\n"
    read_surface(_write(tmp_path, "a.ply", header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"))
    assert opened == ["a.obj", "a.ply"]


@pytest.mark.parametrize("suffix", ["obj", "off", "ply"])
def test_closed_surface_that_was_split_along_seams_is_closed_again(suffix, tmp_path):
    corners = np.array(_BALL.triangles).reshape(-1, 3)
    corners[::2][np.abs(corners[::2]) < 1e-12] = -0.0
    split = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    surface = read_surface(_write(tmp_path, f"a.{suffix}", split.export(file_type=suffix)))
    assert len(surface[0]) == len(_BALL.vertices)
    assert _is_closed(surface)


def test_closed_surface_with_touching_vertices_stays_as_it_is(tmp_path):
    lines = _TETRAHEDRON * 2 + b"v 9 9 9\n"
    for start in (1, 5):
        for face in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)):
            lines += b"f %d %d %d\n" % tuple(start + corner for corner in face)
    vertices, faces = read_surface(_write(tmp_path, "a.obj", lines))
    assert vertices.shape == (9, 3)
    assert faces.max() == 7


def _ply(order, faces, face_property="property list uchar int vertex_indices", vertex_type="float"):
    code = {"binary_little_endian": "<", "binary_big_endian": ">"}[order]
    header = f"ply\nformat {order} 1.0\nelement camera 1\nproperty list int short numbers\nproperty double focus\n"
    header += f"element vertex 4\nproperty uchar red\nproperty {vertex_type} z\nproperty {vertex_type} y\n"
    header += f"property {vertex_type} x\nelement face {len(faces)}\nproperty uchar flag\n{face_property}\nend_header\n"
    content = header.encode() + struct.pack(f"{code}ihhd", 2, 7, 7, 0.5)
    for z, y, x in ((0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)):
        content += struct.pack(f"{code}B3{'d' if vertex_type == 'double' else 'f'}", 9, z, y, x)
    for face in faces:
        content += struct.pack(f"{code}BB{len(face)}i", 9, len(face), *face)
    return content + b"\n\n"


@pytest.mark.parametrize("order", ["binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("vertex_type", ["float", "double"])
def test_ply_with_other_elements_and_mixed_polygons(order, vertex_type, tmp_path):
    triangles = [(0, 2, 1), (0, 1, 3), (1, 2, 3)]
    vertices, faces = read_surface(_write(tmp_path, "a.ply", _ply(order, triangles, vertex_type=vertex_type)))
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(faces, triangles)
    mixed = [(0, 2, 1), (0, 1, 2, 3), (1, 2), (1, 2, 3)]
    _, faces = read_surface(_write(tmp_path, "b.ply", _ply(order, mixed, vertex_type=vertex_type)))
    np.testing.assert_array_equal(faces, [(0, 2, 1), (0, 1, 2), (0, 2, 3), (1, 2, 3)])


def test_off_with_colours_and_polygons(tmp_path):
    text = "COFF 4 2 0 # counts\n\n0 0 0 255 0 0 255\n1 0 0 0 0 0 0\n1 1 0 0 0 0 0\n0 1 0 0 0 0 0\n3 0 1 2 255 0 0\n4 0 1 2 3\n"
    vertices, faces = read_surface(_write(tmp_path, "a.off", text))
    assert vertices.shape == (4, 3)
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])


def test_binary_stl_that_begins_with_solid(tmp_path):
    content = b"solid vertex".ljust(80) + _BALL.export(file_type="stl")[80:]
    assert _is_closed(read_surface(_write(tmp_path, "a.stl", content)))
    content = b"\0" * 80 + _BALL.export(file_type="stl")[80:] + b"more"
    assert _is_closed(read_surface(_write(tmp_path, "b.stl", content)))


_HEADER = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
_FACES = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", b"", "no triangles"),
        ("a.obj", _TETRAHEDRON, "point cloud"),
        ("a.obj", _TETRAHEDRON + b"f 1 2 9\n", "beyond its 4"),
        ("a.obj", _TETRAHEDRON + b"f 1 2 -9\n", "beyond its 4"),
        ("a.obj", _TETRAHEDRON + b"f 0 1 2\n", "beyond its 4"),
        ("a.obj", _TETRAHEDRON + b"f 1 2 99999999999999999999\n", "cannot be read"),
        ("a.obj", _TETRAHEDRON + b"f 1 2 x\n", "cannot be read"),
        ("a.obj", b"v 0 0\n", "wanted 3 coordinates"),
        ("a.obj", b"v 0 0 nan\n" + _TETRAHEDRON + b"f 1 2 3\n", "NaN"),
        ("a.obj", _TETRAHEDRON + b"f 1 1 1\n", "zero area"),
        ("a.obj", b"f" + b" 1" * 600_000, "wanted at most 1048576 bytes"),
        ("a.off", b"hello", "does not begin with OFF"),
        ("a.off", b"OFF\n1000000000000 1 0\n0 0 0\n", "wanted 1000000000000 vertices, got 1"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n5 0 1 2\n", "wanted 5 corners, got 3"),
        ("a.stl", b"", "got 0"),
        ("a.stl", b"\0" * 80 + b"\xff\xff\xff\xff" + b"\0" * 50, "wanted 214748364834"),
        ("a.stl", b"solid x\nvertex 1 2 3\nendsolid", "incomplete"),
        ("a.ply", b"plyboy", "no PLY header"),
        ("a.ply", _HEADER.format(10**12) + _FACES.format(1) + "0 0 0\n", "wanted 1000000000000"),
        ("a.ply", _HEADER.format(3) + _FACES.format(1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "ends before"),
        ("a.ply", _HEADER.format(3) + "end_header\n0 0 0\n1 0 0\n0 1 0\n", "point cloud"),
        ("a.ply", _ply("binary_little_endian", [(0, 1, 2)], "property list float int vertex_indices"), "not an integer"),
        ("a.ply", _ply("binary_little_endian", [(0, 1, 2)], "property list uchar int other"), "one list"),
        ("a.ply", _ply("binary_little_endian", [(0, 1, 2)], "property list uchar magic vertex_indices"), "not understood"),
        ("a.ply", _ply("binary_little_endian", [(0, 1, 2), (0, 1, 2, 3)])[:-9], "ends before"),
        ("a.fbx", b"", "wanted a file ending in"),
        ("a.glb", b"", "no valid JSON"),
        ("a.glb", b'{"asset": {"version": "2.0"}}', "no triangles"),
    ],
)
def test_broken_files_are_refused(name, content, message, tmp_path):
    with pytest.raises(UserError, match=message) as error:
        read_surface(_write(tmp_path, name, content))
    assert name in str(error.value)
    assert str(error.value).isprintable()


def test_missing_file_and_folder_are_refused(tmp_path):
    (tmp_path / "a.ply").mkdir()
    for name, message in (("b.ply", "no mesh at"), ("a.ply", "is not a file")):
        with pytest.raises(UserError, match=message):
            read_surface(tmp_path / name)


def test_folders_are_listed_in_natural_order(tmp_path):
    names = ["Frame_1.obj", "frame_2.obj", "frame_002.ply", "frame_10.OBJ", "frame_10_b.stl", f"frame_{10**40}.off"]
    for name in [*reversed(names), ".hidden.obj", "notes.txt", "poses.npz"]:
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.obj").mkdir()
    listed = [path.name for path in list_surfaces(tmp_path)]
    assert listed[1:3] in (names[1:3], names[2:0:-1])
    assert [listed[0], *listed[3:]] == [names[0], *names[3:]]
    (tmp_path / "empty").mkdir()
    assert list_surfaces(tmp_path / "empty") == []
    for path in (tmp_path / "none", tmp_path / "notes.txt"):
        with pytest.raises(UserError, match="no folder"):
            list_surfaces(path)


def test_list_of_suffixes_is_complete():
    assert set(SURFACE_SUFFIXES) == {".obj", ".ply", ".stl", ".off", ".glb", ".gltf"}
