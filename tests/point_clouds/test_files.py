"""Files of points: every format gives the same points, and damaged files are one line."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import trimesh

from snarfcli.errors import UserError
from snarfcli.point_clouds import PointFile, list_frames, read_frame, read_points

POINTS = np.random.default_rng(0).standard_normal((40, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
COLOURS = np.random.default_rng(1).integers(0, 256, (40, 3))


def rows(*columns: np.ndarray, separator: str = " ") -> str:
    return "".join(separator.join(f"{value:.9g}" for value in row) + "\n" for row in np.concatenate(columns, axis=1))


def text_ply(*columns: np.ndarray, names: str) -> str:
    properties = "".join(f"property float {name}\n" for name in names.split())
    return f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n{properties}end_header\n{rows(*columns)}"


def binary_ply() -> bytes:
    names = "".join(f"property double {name}\n" for name in ("nx", "ny", "nz", "x", "y", "z"))
    header = f"ply\nformat binary_big_endian 1.0\nelement vertex {len(POINTS)}\n{names}end_header\n"
    return header.encode() + b"".join(struct.pack(">6d", *row) for row in np.concatenate([NORMALS, POINTS], axis=1))


def array_file(save, **arrays) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *(arrays.values() if save is np.save else ()), **({} if save is np.save else arrays))
    return buffer.getvalue()


def obj(*, with_normals: bool) -> str:
    text = "# scan\n" + "".join(f"v {line}\n" for line in rows(POINTS).splitlines())
    return text + ("".join(f"vn {line}\n" for line in rows(NORMALS).splitlines()) if with_normals else "")


WITHOUT_NORMALS = {
    "a.ply": text_ply(POINTS, names="x y z"),
    "colours.ply": text_ply(COLOURS, POINTS, names="red green blue x y z"),
    "a.obj": obj(with_normals=False),
    "a.off": f"OFF\n{len(POINTS)} 0 0\n{rows(POINTS)}",
    "a.xyz": rows(POINTS),
    "counted.xyz": f"{len(POINTS)}\nmade by hand\n{rows(POINTS, COLOURS)}",
    "a.csv": "x,y,z,r,g,b\n" + rows(POINTS, COLOURS, separator=","),
    "a.txt": "// x y z\n" + rows(POINTS, separator="\t").replace("\n", "\r\n"),
    "a.npy": array_file(np.save, points=POINTS),
    "a.npz": array_file(np.savez, points=POINTS, other=np.zeros(3)),
    "ints.npz": array_file(np.savez_compressed, vertices=POINTS, normal_map=np.zeros(2)),
}
WITH_NORMALS = {
    "n.ply": text_ply(POINTS, NORMALS, names="x y z nx ny nz"),
    "binary.ply": binary_ply(),
    "n.obj": obj(with_normals=True),
    "n.xyz": rows(POINTS, NORMALS),
    "colours.txt": rows(POINTS, COLOURS, NORMALS),
    "intensity.csv": "x;y;z;i;nx;ny;nz\n" + rows(POINTS, COLOURS[:, :1], NORMALS, separator=";"),
    "n.npy": array_file(np.save, points=np.concatenate([POINTS, NORMALS], axis=1)),
    "n.npz": array_file(np.savez, positions=POINTS, normals=NORMALS),
}


def write(folder, name: str, content: str | bytes):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", [*WITHOUT_NORMALS, *WITH_NORMALS])
def test_every_format_gives_the_points(name, tmp_path):
    path = write(tmp_path, name, {**WITHOUT_NORMALS, **WITH_NORMALS}[name])
    for read in (read_points, read_frame):
        found = read(path)
        assert isinstance(found, PointFile)
        np.testing.assert_allclose(found.points, POINTS, atol=1e-7)
        if name in WITHOUT_NORMALS:
            assert found.normals is None
        else:
            assert found.normals is not None
            np.testing.assert_allclose(found.normals, NORMALS, atol=1e-7)


@pytest.mark.parametrize("with_normals", [False, True])
def test_points_that_occur_several_times_are_kept_once(with_normals, tmp_path):
    again = np.concatenate([np.arange(40), np.arange(39, -1, -1), [7, 7]])
    arrays = {"points": POINTS[again]} | ({"normals": np.concatenate([NORMALS, np.ones((42, 3))])} if with_normals else {})
    found = read_points(write(tmp_path, "a.npz", array_file(np.savez, **arrays)))
    np.testing.assert_array_equal(found.points, POINTS)
    if with_normals:
        np.testing.assert_array_equal(found.normals, NORMALS)
    beside = POINTS[0] + np.array([0.7825, 0.0, -0.5377])  # as far along the direction that is compared first
    different = np.stack([POINTS[0], beside, POINTS[0]])
    np.testing.assert_array_equal(
        read_points(write(tmp_path, "b.npy", array_file(np.save, points=different))).points, different[:2]
    )


@pytest.mark.parametrize("suffix", ["ply", "obj", "off", "stl", "glb"])
def test_a_frame_with_triangles_is_a_surface(suffix, tmp_path):
    path = write(tmp_path, f"a.{suffix}", trimesh.creation.icosphere(1).export(file_type=suffix))  # pyright: ignore[reportArgumentType]
    found = read_frame(path)
    assert not isinstance(found, PointFile)
    assert len(found[1]) == 80
    if suffix in ("ply", "obj", "off"):
        np.testing.assert_array_equal(read_points(path).points, found[0])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", b"", "no points"),
        ("a.xyz", b"1 2\n3 4\n", "no points"),
        ("a.xyz", b"1 2 3\n4 5 6 7\n", "wanted 3 numbers, got 4"),
        ("a.xyz", b"1 2 3\n4 5 x\x1b[2J\n", "wanted 3 numbers, got b'4 5 x"),
        ("a.xyz", b"1 2 nan\n", "1 of its 1 points are NaN"),
        ("a.xyz", b"1 2 1e999\n", "NaN or infinite"),
        ("a.csv", b"1" + b",1" * 20, "wanted 16 numbers"),
        ("a.obj", b"v 1 2\n", "wanted 3 coordinates"),
        ("a.obj", b"", "no points"),
        ("a.ply", b"plyboy", "no PLY header"),
        ("a.npy", b"x", "a.npy"),
        ("a.npy", array_file(np.save, points=np.zeros((2, 2))), "wanted an array"),
        ("a.npy", array_file(np.save, points=np.zeros(3)), "wanted an array"),
        ("a.npy", array_file(np.save, points=np.array([["a"] * 3])), "array of numbers"),
        ("a.npz", array_file(np.savez, x=np.zeros((2, 3))), "wanted an array called points"),
        ("a.npz", array_file(np.savez, points=np.zeros((2, 3)), normals=np.zeros((3, 3))), "wanted points and normals"),
        ("a.npz", b"x", "not an .npz"),
        ("a.glb", b"", "a.glb"),
        ("a.las", b"", "wanted a file ending in"),
    ],
)
def test_damaged_files_are_one_line(name, content, message, tmp_path):
    path = write(tmp_path, name, content)
    with pytest.raises(UserError, match=message) as error:
        read_frame(path)
    assert name in str(error.value)
    assert str(error.value).isprintable()


def test_files_without_points_cannot_be_read_as_points(tmp_path):
    with pytest.raises(UserError, match="wanted a file ending in"):
        read_points(tmp_path / "a.glb")
    with pytest.raises(UserError, match="no mesh at"):
        read_points(tmp_path / "a.ply")


def test_arrays_of_objects_are_not_unpickled(tmp_path):
    content = array_file(np.save, points=np.array([{"a": 1}], object))
    with pytest.raises(UserError, match="objects"):
        read_points(write(tmp_path, "a.npy", content))


def test_frames_are_surfaces_or_else_points_of_one_format(tmp_path):
    for name in ("b10.xyz", "b9.xyz", "notes.txt", "1.txt", "poses.npz", ".hidden.xyz"):
        write(tmp_path, name, b"1 2 3\n")
    assert [path.name for path in list_frames(tmp_path)] == ["b9.xyz", "b10.xyz"]
    for path in tmp_path.glob("*.xyz"):
        path.unlink()
    assert [path.name for path in list_frames(tmp_path, ("poses.npz",))] == ["1.txt"]
    write(tmp_path, "a.ply", b"")
    assert [path.name for path in list_frames(tmp_path)] == ["a.ply"]
