"""Targets of the fuzzer for files of meshes and of points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from fuzz_arrays import even_numbers, odd_npz
from fuzzing import Target

__all__ = ["SURFACE_TARGETS"]


def _surface_target(name: str, suffix: str, seeds: Callable[[], list[bytes]]) -> Target:
    from snarfcli.formats.surfaces import read_surface

    return Target(name, suffix, seeds, read_surface)


def surface_obj() -> Target:
    corners = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    return _surface_target(
        "surface_obj",
        ".obj",
        lambda: [
            corners + b"f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n",
            b"# x\r\nmtllib a.mtl\r\no one\r\n" + corners + b"vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3//1 \\\n4\nf -4 -3 -2\n",
        ],
    )


def surface_off() -> Target:
    return _surface_target(
        "surface_off",
        ".off",
        lambda: [
            b"OFF\n4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 2 0 3\n",
            b"OFF4 2 0\r0 0 0\r1 0 0 1\r1 1\r0\r0 1 0\r4 0 1\r2 3\r3 0 1 2\r",
            b"NOFF 3 1 0 0 0 0 0 0 1 1 0 0 0 0 1 0 1 0 0 0 1 3 0 1 2",
            b"COFF 4 2 0 # x\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n1 1 0 1 0 0 1\n0 1 0 1 0 0 1\n\n4 0 1 2 3 9 9\n3 0 1 2\n",
        ],
    )


def surface_ply() -> Target:
    import struct

    head = b"ply\nformat %s 1.0\ncomment TextureFile a.png\nelement vertex 4\nproperty %s x\nproperty %s y\nproperty %s z\n"
    faces = b"property uchar red\nelement face %d\nproperty list uchar int vertex_indices\nend_header\n"

    def seeds() -> list[bytes]:
        corners, made = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], []
        text = b"0 0 0 1\n1 0 0 1\n0 1 0 1\n0 0 1 1\n3 0 2 1\n4 0 1 2 3\n"
        made.append(head % ((b"ascii",) + (b"float",) * 3) + faces % 2 + text)
        for order, code, polygons in (
            (b"binary_little_endian", "<", [(0, 2, 1), (0, 1, 3), (1, 2, 3)]),
            (b"binary_big_endian", ">", [(0, 2, 1), (0, 1, 3, 2), (1, 2, 3)]),
        ):
            content = head % ((order,) + (b"double",) * 3) + faces % len(polygons)
            content += b"".join(struct.pack(f"{code}3dB", *corner, 7) for corner in corners)
            made.append(content + b"".join(struct.pack(f"{code}B{len(p)}i", len(p), *p) for p in polygons))
            made.append(made[-1].replace(b"\n", b"\r\n" if code == ">" else b"\r", 9))
        strips = b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
        lists = b"property uchar red\nproperty list uchar float weights\n"
        made.append(
            head % ((b"ascii",) + (b"float",) * 3)
            + lists
            + strips
            + b"0 0 0 1 0\n1 0 0 1 2 .5 .5\n0 1 0 1 0\n0 0 1 1 0\n6 0 1 2 -1 3 1\n"
        )
        return made

    return _surface_target("surface_ply", ".ply", seeds)


def surface_stl() -> Target:
    import trimesh

    def seeds() -> list[bytes]:
        box = trimesh.creation.box()
        return [box.export(file_type="stl"), box.export(file_type="stl_ascii").encode()]

    return _surface_target("surface_stl", ".stl", seeds)


def _point_target(name: str, suffix: str, seeds: Callable[[], list[bytes]], extra=None) -> Target:
    from snarfcli.point_clouds import read_frame

    return Target(name, suffix, seeds, read_frame, extra)


def points_text() -> Target:
    return _point_target(
        "points_text",
        ".xyz",
        lambda: [
            b"3\nmade by hand\n0 0 0 255 0 0 0 0 1\n1 0 0 255 0 0 0 1 0\n0 1 0 0 0 0 1 0 0\n",
            b"x,y,z,nx,ny,nz\r\n0,0,1,0,0,1\r\n0,1,0,0,1,0\r\n# end\r\n",
            b"// points\n1e-3;2;3\n4;5;6\n-7;.8;9",
        ],
    )


def points_ply() -> Target:
    import struct

    def seeds() -> list[bytes]:
        names = b"".join(b"property float %s\n" % name for name in (b"x", b"y", b"z", b"nx", b"ny", b"nz"))
        head = b"ply\nformat %s 1.0\nelement vertex 3\n" + names + b"end_header\n"
        numbers = [float(number % 5) for number in range(18)]
        text = b"\n".join(b" ".join(b"%g" % value for value in numbers[row : row + 6]) for row in (0, 6, 12))
        return [head % b"ascii" + text, head % b"binary_little_endian" + struct.pack("<18f", *numbers)]

    return _point_target("points_ply", ".ply", seeds)


def points_obj() -> Target:
    lines = b"v 0 0 1 1 0 0\nvn 0 0 1\nv 0 1 0\nvn 0 1 0\n"
    return _point_target("points_obj", ".obj", lambda: [lines, b"# x\r\n" + lines + b"v 1 \\\n0 0\n"])


def points_npz() -> Target:
    import io

    def seeds() -> list[bytes]:
        points, made = even_numbers(4, 3), []
        for arrays in ({"points": points, "normals": points}, {"vertices": points.astype("f8")}, {"xyz": even_numbers(3, 6)}):
            buffer = io.BytesIO()
            np.savez(buffer, **arrays)
            made.append(buffer.getvalue())
        return made

    return _point_target("points_npz", ".npz", seeds, odd_npz)


SURFACE_TARGETS: tuple[Callable[[], Target], ...] = (
    surface_obj,
    surface_off,
    surface_ply,
    surface_stl,
    points_text,
    points_ply,
    points_obj,
    points_npz,
)
