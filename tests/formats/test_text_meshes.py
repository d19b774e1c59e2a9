"""Mesh files as other programs write them: line ends, values that continue in the next line, parts that few writers use."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import trimesh

from snarfcli.formats.surfaces import read_surface

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
QUADS = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
FANS = np.array([(a, *pair) for a, b, c, d in QUADS for pair in ((b, c), (c, d))])
ENDS = ("\n", "\r\n", "\r")


def read(tmp_path, name: str, content: str | bytes):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode("latin-1"))
    return read_surface(path)


def is_the_cube(surface) -> None:
    vertices, faces = surface
    np.testing.assert_array_equal(vertices, CORNERS)
    np.testing.assert_array_equal(faces, FANS)


# ---------------------------------------------------------------- PLY
def ply_header(order: str, *, extra: str = "", faces: str = "list uchar int vertex_indices", count: int = 6) -> str:
    lines = ["ply", f"format {order} 1.0", "comment made by \xc5 \x1c\x0b, not end_header", "element vertex 8"]
    lines += [f"property float {axis}" for axis in "xyz"]
    return "\n".join([*lines, *([extra] if extra else []), f"element face {count}", f"property {faces}", "end_header", ""])


def ply_data(code: str, vertices: np.ndarray = CORNERS) -> bytes:
    polygons = b"".join(struct.pack(f"{code}B4i", 4, *quad) for quad in QUADS)
    return vertices.astype(f"{code}f4").tobytes() + polygons


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("order", ["binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("more", [b"", b"\n", b"more"])
def test_ply_headers_end_their_lines_in_any_way(tmp_path, order, end, more):
    code = "<" if "little" in order else ">"
    is_the_cube(read(tmp_path, "a.ply", ply_header(order).replace("\n", end).encode("latin-1") + ply_data(code) + more))


@pytest.mark.parametrize("byte", [b"\n", b"\r", b" "])
@pytest.mark.parametrize("end", ENDS)
def test_data_that_begins_like_a_line_end_is_data(tmp_path, end, byte):
    """The first byte of the first coordinate is the last of a big-endian number's first byte."""
    first = np.frombuffer(byte + b"\x80\x00\x00", ">f4")[0]
    vertices = CORNERS.copy()
    vertices[0, 0] = first
    header = ply_header("binary_big_endian").replace("\n", end).encode("latin-1")
    got, faces = read(tmp_path, "a.ply", header + ply_data(">", vertices))
    np.testing.assert_array_equal(got, vertices)
    np.testing.assert_array_equal(faces, FANS)


@pytest.mark.parametrize(("most", "last"), [("\r", "\r\n"), ("\n", "\r\n"), ("\n", "\r"), ("\r\n", "\n"), ("\r\n", "\r")])
def test_ply_headers_with_mixed_line_ends(tmp_path, most, last):
    header = ply_header("binary_little_endian").replace("\n", most).removesuffix(most) + last
    is_the_cube(read(tmp_path, "a.ply", header.encode("latin-1") + ply_data("<")))


@pytest.mark.parametrize("end", ENDS)
def test_text_ply_with_any_line_ends(tmp_path, end):
    text = ply_header("ascii") + "".join("{:g} {:g} {:g}\n".format(*corner) for corner in CORNERS)
    text += "".join("4 {} {} {} {}\n".format(*quad) for quad in QUADS)
    is_the_cube(read(tmp_path, "a.ply", "\xef\xbb\xbf" + text.replace("\n", end)))


@pytest.mark.parametrize("count", ["char", "uchar", "short", "ushort", "int", "uint", "int8", "uint16", "int64"])
@pytest.mark.parametrize("index", ["char", "ushort", "uint", "int32", "uint64"])
def test_ply_lists_of_any_integers(tmp_path, count, index):
    codes = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "int8": "b", "uint16": "H"}
    codes |= {"int64": "q", "int32": "i", "uint64": "Q"}
    header = ply_header("binary_little_endian", faces=f"list {count} {index} vertex_index").encode("latin-1")
    polygons = b"".join(struct.pack(f"<{codes[count]}4{codes[index]}", 4, *quad) for quad in QUADS)
    is_the_cube(read(tmp_path, "a.ply", header + CORNERS.astype("<f4").tobytes() + polygons))


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian"])
def test_ply_vertices_may_have_lists_and_other_elements_lie_between(tmp_path, order):
    extra = "property list uchar float weights\nproperty uchar red\nelement edge 2\nproperty int a\nproperty list uchar short b"
    header = ply_header(order, extra=extra).encode("latin-1")
    if order == "ascii":
        lines = [
            "{:g} {:g} {:g} {} {} 7".format(*corner, k % 3, " ".join(["0.5"] * (k % 3))) for k, corner in enumerate(CORNERS)
        ]
        lines += ["1 2 3 4", "1 0", *("4 {} {} {} {}".format(*quad) for quad in QUADS)]
        is_the_cube(read(tmp_path, "a.ply", header + "\n".join(lines).encode()))
        return
    data = b"".join(struct.pack(f"<3fB{k % 3}fB", *corner, k % 3, *[0.5] * (k % 3), 7) for k, corner in enumerate(CORNERS))
    data += struct.pack("<iB2h", 1, 2, 3, 4) + struct.pack("<iB", 1, 0)
    is_the_cube(read(tmp_path, "a.ply", header + data + b"".join(struct.pack("<B4i", 4, *quad) for quad in QUADS)))


def test_ply_strips_of_triangles(tmp_path):
    """Two strips, which -1 separates; every triangle faces outwards."""
    header = ply_header("binary_little_endian", faces="list int int vertex_indices", count=1).replace("face 1", "tristrips 1")
    strip = [1, 0, 2, 3, 6, 7, 5, 4, 1, 0, -1, 1, 2, 5, 6, -1, 0, 4, 3, 7]
    data = CORNERS.astype("<f4").tobytes() + struct.pack(f"<i{len(strip)}i", len(strip), *strip)
    vertices, faces = read(tmp_path, "a.ply", header.encode("latin-1") + data)
    cube = trimesh.Trimesh(vertices, faces, process=False)
    assert cube.is_watertight
    assert cube.volume == pytest.approx(1)


# ---------------------------------------------------------------- OFF
def off_text(
    *, kind: str = "", vertex_extra: str = "", face_extra: str = "", gap: str = " ", counts: str = "\n8 6 12\n"
) -> str:
    rows = [" ".join(f"{value:g}" for value in corner) + vertex_extra for corner in CORNERS]
    rows += [gap.join(map(str, (4, *quad))) + face_extra for quad in QUADS]
    return f"{kind}OFF{counts}" + "\n".join(rows) + "\n"


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"counts": " 8 6 12\n"},
        {"counts": "8 6 12\n"},  # ModelNet
        {"counts": "\n8 6\n"},
        {"counts": "\n8\n6\n0\n"},
        {"counts": "  # a cube\n\n# of quads\n8 6 12 # without edges\n"},
        {"gap": "\n"},
        {"gap": " \n\t"},
        {"gap": " # corner\n\n"},
        {"gap": "\n", "face_extra": " 255 0 0"},
        {"face_extra": " 0.5 0.5 0.5 1"},
        {"kind": "C", "vertex_extra": " 255 0 0"},
        {"kind": "C", "vertex_extra": " 1 0 0 1", "gap": "\n"},
        {"kind": "C", "vertex_extra": "\n1 0 0 1"},
        {"kind": "C", "vertex_extra": "\n255 0 0", "gap": "\n"},
        {"kind": "N", "vertex_extra": " 0 0 1"},
        {"kind": "CN", "vertex_extra": " 0 0 1 1 0 0 1"},
        {"kind": "ST", "vertex_extra": " 0.5 0.5"},
        {"kind": "STCN4", "vertex_extra": " 1 0 0 1 1 0 0 1 0.5 0.5"},
        {"kind": "c", "vertex_extra": " 1 0 0"},
        {"vertex_extra": " 1 0 0"},  # colours that the header does not announce
        {"kind": "C"},  # and colours that are announced, but missing
    ],
)
def test_off_files_with_values_over_several_lines(tmp_path, options, end):
    text = off_text(**options)
    is_the_cube(read(tmp_path, "a.off", text.replace("\n", end)))
    is_the_cube(read(tmp_path, "b.off", text + "# the end\n\n0 1\n"))


@pytest.mark.parametrize("kind", ["", "N"])
def test_off_files_that_share_lines(tmp_path, kind):
    words = off_text(kind=kind, vertex_extra=" 0 0 1" if kind else "").split()
    for width in (7, 19, 1000):
        lines = [" ".join(words[start : start + width]) for start in range(0, len(words), width)]
        is_the_cube(read(tmp_path, f"{width}.off", "\n".join(lines)))


def test_off_files_as_trimesh_reads_them(tmp_path):
    for text in (off_text(), off_text(counts=" 8 6 12\n"), off_text(kind="C", vertex_extra=" 255 0 0 255")):
        theirs = trimesh.load(io.BytesIO(text.encode()), file_type="off", process=False)
        vertices, faces = read(tmp_path, "a.off", text)
        np.testing.assert_array_equal(theirs.vertices, vertices)
        assert theirs.volume == pytest.approx(trimesh.Trimesh(vertices, faces, process=False).volume)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("OFF BINARY\n", "binary OFF"),
        ("nOFF\n3\n8 6 12\n", "any number of coordinates"),
        ("OFF\n", "numbers of vertices and faces are missing"),
        ("OFF\n-8 6 12\n", "at least 0, got -8 and 6"),
        (off_text().replace("4 3 0 4 7", "4 3 0 4"), "wanted 4 corners, got 3"),
        (off_text().replace("4 0 3 2 1\n", ""), "wanted 6 faces, got"),
        (off_text().replace("4 0 3 2 1", "-1"), "wanted at most 1000000 corners, got -1"),
        ("OFF 1 1 0 0 0 0 3 0 0 0 9\n", "more numbers than"),
    ],
)
def test_damaged_off_files_are_refused(tmp_path, text, message):
    from snarfcli.errors import UserError

    with pytest.raises(UserError, match=message):
        read(tmp_path, "a.off", text)


# ---------------------------------------------------------------- OBJ
@pytest.mark.parametrize("end", ENDS)
def test_obj_faces_continue_and_count_backwards(tmp_path, end):
    text = "\xef\xbb\xbf# a cube\n"
    for number, corner in enumerate(CORNERS):
        text += "v {:g} \\\n{:g} \\ \n  {:g}\n".format(*corner) if number % 2 else "v\t{:g}  {:g} {:g} 1.0\n".format(*corner)
    for number, quad in enumerate(QUADS):
        corners = [corner + 1 if number % 2 else corner - 8 for corner in quad]
        text += "f {}/1/2 {}//3 \\\n {}/4 {} # back\n".format(*corners)
    is_the_cube(read(tmp_path, "a.obj", text.replace("\n", end)))


def test_obj_with_mixed_line_ends(tmp_path):
    lines = ["v {:g} {:g} {:g}".format(*corner) for corner in CORNERS]
    lines += ["f {} {} {} {}".format(*(corner + 1 for corner in quad)) for quad in QUADS]
    text = "".join(line + ENDS[number % 3] for number, line in enumerate(lines))
    is_the_cube(read(tmp_path, "a.obj", text))


# ---------------------------------------------------------------- STL
@pytest.mark.parametrize(
    ("old", "new"), [(" ", "\t  "), ("\n", "\r"), ("\n", "\r\n"), ("\n", " "), (" ", "\n"), ("vertex", "VERTEX")]
)
def test_text_stl_with_odd_white_space(tmp_path, old, new):
    cube = trimesh.Trimesh(CORNERS, FANS, process=False)
    text = "solid vertex of a cube\n"
    for corners in cube.triangles:
        text += "facet normal 0 0 1\n  outer loop\n"
        text += "".join("    vertex {:g} {:g} {:.3e}\n".format(*corner) for corner in corners)
        text += "  endloop\nendfacet\n"
    text = text.replace("solid vertex of a cube\n", "solid\n" if (old, new) == (" ", "\n") else "solid vertex of a cube\n")
    vertices, faces = read(tmp_path, "a.stl", text.replace(old, new) + "endsolid vertex of a cube")
    got = trimesh.Trimesh(vertices, faces, process=False)
    assert len(vertices) == 8
    assert got.is_watertight
    assert got.volume == pytest.approx(1)
