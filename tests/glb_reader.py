"""An independent reader of characters in `.glb` files: pygltflib and NumPy, written from the specification.

Source: Khronos, glTF 2.0 specification, 3.6.2 (accessors), 3.7.2.2 (morph targets), 3.7.3 (skins), 3.11 (animations).
"""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
ROOT = Path(__file__).parents[1]
READERS = ROOT / "build" / "readers"
SCRIPTS = Path(__file__).parent / "readers"
needs_readers = pytest.mark.skipif(
    not shutil.which("node") or not (READERS / "node_modules" / "three").is_dir(),
    reason="wants node, and three.js and the Khronos validator in build/readers, which tools/set_up.sh puts there",
)


def run_reader(script: str, *arguments: object) -> dict:
    """Run a script of tests/readers in node and return the JSON that it prints."""
    command = ["node", "--input-type=module", "-", *map(str, arguments)]
    done = subprocess.run(
        command, input=(SCRIPTS / script).read_text(), cwd=READERS, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


class GlbReader:
    """A file with one skinned mesh."""

    def __init__(self, path: Path) -> None:
        pygltflib = pytest.importorskip("pygltflib", reason="an independent reader of glTF")
        self.gltf = pygltflib.GLTF2().load(str(path))
        self.binary = self.gltf.binary_blob()
        (self.mesh_node,) = [number for number, node in enumerate(self.gltf.nodes) if node.mesh is not None]
        node = self.gltf.nodes[self.mesh_node]
        self.mesh, self.skin = self.gltf.meshes[node.mesh], self.gltf.skins[node.skin]
        (self.primitive,) = self.mesh.primitives
        self.parents = {child: number for number, node in enumerate(self.gltf.nodes) for child in node.children or []}
        self.clips = {animation.name: animation for animation in self.gltf.animations}

    def array(self, number: int) -> np.ndarray:
        """Return the values of an accessor in float64 or int64."""
        accessor = self.gltf.accessors[number]
        view = self.gltf.bufferViews[accessor.bufferView]
        width = _TYPES[accessor.type]
        dtype = np.dtype(_DTYPES[accessor.componentType])
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        stride = view.byteStride or width * dtype.itemsize
        assert start + (accessor.count - 1) * stride + width * dtype.itemsize <= view.byteOffset + view.byteLength
        values = np.ndarray((accessor.count, width), dtype, self.binary, start, (stride, dtype.itemsize))
        if accessor.normalized:
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        values = values.astype(np.int64 if values.dtype.kind in "iu" else np.float64)
        return values[:, 0] if width == 1 else values

    def attribute(self, name: str) -> np.ndarray:
        """Return an attribute of the vertices, [V, ...]."""
        return self.array(getattr(self.primitive.attributes, name))

    def faces(self) -> np.ndarray:
        """Return the triangles [F, 3]."""
        return self.array(self.primitive.indices).reshape(-1, 3)

    def dense_weights(self) -> np.ndarray:
        """Return the skinning weights [V, J] for the joints of the skin."""
        dense = np.zeros((len(self.attribute("POSITION")), len(self.skin.joints)))
        for number in range(2):
            if getattr(self.primitive.attributes, f"JOINTS_{number}", None) is not None:
                joints, weights = self.attribute(f"JOINTS_{number}"), self.attribute(f"WEIGHTS_{number}")
                np.add.at(dense, (np.arange(len(dense))[:, None], joints), weights)
        return dense

    def values(self, clip: str, time: float) -> dict[tuple[int, str], np.ndarray]:
        """Return the values of the channels of a clip at a time, by node and path."""
        animation, found = self.clips[clip], {}
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            assert sampler.interpolation in (None, "LINEAR")
            times, output = self.array(sampler.input), self.array(sampler.output)
            output = output.reshape(len(times), -1)
            after = int(np.searchsorted(times, time, side="right").clip(1, max(len(times) - 1, 1)))
            before = after - 1
            if len(times) == 1:
                value = output[0]
            else:
                share = np.clip((time - times[before]) / (times[after] - times[before]), 0, 1)
                way = _slerp if channel.target.path == "rotation" else _lerp
                value = way(output[before], output[after], share)
            found[channel.target.node, channel.target.path] = value
        return found

    def vertices(self, clip: str, time: float) -> np.ndarray:
        """Return the vertices [V, 3] in the world at a time of a clip."""
        values = self.values(clip, time)
        positions = self.attribute("POSITION").copy()
        weights = values.get((self.mesh_node, "weights"), self.mesh.weights or [])
        targets = self.primitive.targets or []
        assert len(weights) == len(targets)
        for weight, target in zip(weights, targets, strict=True):
            positions += weight * self.array(target["POSITION"])
        worlds: dict[int, np.ndarray] = {}
        inverse = self.array(self.skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        moved = np.stack([self._world(joint, values, worlds) for joint in self.skin.joints]) @ inverse
        blended = np.einsum("vj,jab->vab", self.dense_weights(), moved)
        return np.einsum("vab,vb->va", blended[:, :3, :3], positions) + blended[:, :3, 3]

    def _world(self, number: int, values: dict, worlds: dict) -> np.ndarray:
        if number not in worlds:
            node = self.gltf.nodes[number]
            assert not node.matrix
            translation = values.get((number, "translation"), node.translation or [0, 0, 0])
            rotation = values.get((number, "rotation"), node.rotation or [0, 0, 0, 1])
            scale = values.get((number, "scale"), node.scale or [1, 1, 1])
            local = np.eye(4)
            local[:3, :3] = _matrix(np.asarray(rotation)) * np.asarray(scale)
            local[:3, 3] = translation
            worlds[number] = self._world(self.parents[number], values, worlds) @ local if number in self.parents else local
        return worlds[number]


def _lerp(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    return (1 - share) * a + share * b


def _slerp(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    cosine = a @ b
    b, cosine = (-b, -cosine) if cosine < 0 else (b, cosine)
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        return _lerp(a, b, share)
    return (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
