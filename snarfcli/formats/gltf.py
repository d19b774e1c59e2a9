"""Reading glTF 2.0 files (`.glb`, `.gltf`): rigged characters, robots of rigid parts, and meshes that stand still.

Source: Khronos, glTF 2.0 specification.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.gltf_file import GltfFile
from snarfcli.formats.gltf_mesh import MeshReader, Piece, dense_weights, join_pieces, moved, welded
from snarfcli.formats.gltf_motion import read_animations
from snarfcli.formats.gltf_nodes import NodeTree
from snarfcli.formats.gltf_place import placed_skins
from snarfcli.formats.rig import Rig, RigClip, RigMesh
from snarfcli.names import unique_names

__all__ = ["read_gltf", "read_gltf_surface"]

log = logging.getLogger(__name__)

# Places of nodes in one clip, and of joints in all clips, 128 bytes each.
_MAX_NODE_FRAMES = 1_500_000
_MAX_JOINT_FRAMES = 2_000_000
_MAX_SKIN_JOINTS = 100_000  # of all skins together


@dataclass(frozen=True, eq=False)
class _Skin:
    joints: list[int]
    """J nodes."""
    inverse_bind: NDArray[np.float64]
    """[J, 4, 4] from the frame in which the mesh is stored to the joint's own."""


def read_gltf(path: str | Path, *, frame_rate: float | None = None) -> Rig:
    """Read the joints, the motions and the mesh of a `.glb` or `.gltf` file.

    Where things are. A skin's joint moves a vertex, as stored, by `world_from_joint(t) @ inverse_bind`; the transform of the
    node that holds a skinned mesh counts for nothing (glTF 2.0, 3.7.3.3). The frame in which a mesh is stored is the
    exporter's choice: often the world, often centimetres with z up below a node that scales by 0.01. One matrix
    `world_from_bind` turns it into the world: `rest = world_from_bind @ inv(inverse_bind)`, and the vertices alike, which
    leaves `world_from_joint(t) @ inv(rest)` as it was. Where the nodes stand in the bind pose, as in most files, that matrix is
    exactly known, and `rest` is where they stand; else it takes over their scale, and turns by quarters only.

    - Joints are those of the skins in the default scene, in the file's order, each after its parent; what lies between two
      joints, or above the first, is part of their motion. Names are made unique.
    - All triangles of the skins are one mesh, and those of unskinned nodes below a joint, which follow it rigidly. Unskinned
      meshes elsewhere are left out. Vertices split along seams are welded where position and weights are the same to the last
      bit. Morph targets, materials and textures are not looked at.
    - A file without skins gives each node that has a mesh, or moves one, as a joint, and the mesh follows it rigidly.

    Args:
        path: the file; its buffers lie in it or beside it.
        frame_rate: at which animations are sampled, frames a second, from the first key to the last; None for each one's own
            (`extras.frame_rate`, as this package writes it, or what equally spaced keys show), and 30 where it has none.

    Raises:
        UserError: the file is missing, damaged, compressed (Draco, meshopt) or absurdly large, or it holds nothing that moves,
            or joints of scale zero.
        ValueError: `frame_rate` is not positive.
    """
    if frame_rate is not None and not frame_rate > 0:
        raise ValueError(f"frame_rate: wanted a positive number, got {frame_rate}")
    file = GltfFile(path)
    tree = NodeTree(file)
    animations = read_animations(file, frame_rate)
    meshes = [(node, *_mesh_of(file, tree, node)) for node in tree.in_scene() if "mesh" in tree.nodes[node]]
    skins = {number: _read_skin(file, number) for number in _used_skins(file, meshes)}
    with np.errstate(all="ignore"):  # overflow is found by _check_transforms
        if skins:
            joints = list(dict.fromkeys(joint for skin in skins.values() for joint in skin.joints))
        else:
            holders = {node for node, _, _ in meshes}
            moving = {node for animation in animations for node in animation.nodes}
            joints = [n for n in tree.with_ancestors(holders or moving) if n in holders or n in moving]
        if not joints:
            file.fail("holds no skin, no mesh and no animation; give the file of a rigged character")
        joints, parents = _sorted_joints(tree, joints)
        names = _unique((tree.nodes[joint].get("name") for joint in joints), "joint")
        relevant = tree.with_ancestors([*joints, *(node for node, _, _ in meshes)])
        here = {node: world[0] for node, world in tree.worlds(relevant).items()}
        _check_transforms(file, np.stack([here[joint] for joint in joints]), names, "")
        rest, pieces = _rest_and_pieces(file, tree, skins, meshes, joints, here)
        _check_transforms(file, rest, names, " at rest")
        clips = []
        relevant, joint_frames = tree.with_ancestors(joints), 0
        clip_names = _unique((animation.name for animation in animations), "clip")
        for name, animation in zip(clip_names, animations, strict=True):
            joint_frames += (animation.num_frames + 20) * len(joints)  # 20: what a node costs even if it stands still
            if (animation.num_frames + 20) * len(relevant) > _MAX_NODE_FRAMES or joint_frames > _MAX_JOINT_FRAMES:
                file.fail(f"its animations have too many frames for {len(relevant)} nodes; export fewer, or cut them")
            worlds = tree.worlds(relevant, animation.nodes)
            poses = np.empty((animation.num_frames, len(joints), 4, 4))
            for column, joint in enumerate(joints):
                poses[:, column] = worlds[joint]
            _check_transforms(file, poses, names, f" in clip {name}")
            clips.append(RigClip(name, animation.frame_rate, poses))
        whole = welded(join_pieces(pieces))
        mesh = None
        if len(whole.faces):
            if not np.isfinite(whole.vertices).all():
                file.fail("its vertices are too far away to be numbers; repair it or export it again")
            mesh = RigMesh(whole.vertices, whole.faces, dense_weights(file, whole, len(joints)))
    return Rig(names, parents, rest, tuple(clips), mesh)


def read_gltf_surface(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read all triangles of the default scene as they stand, skins in the pose of the nodes, welded by position.

    Returns:
        Vertices [V, 3] in the world, and faces [F, 3], which may be none.

    Raises:
        UserError: the file is missing, damaged, compressed (Draco, meshopt) or absurdly large.
    """
    file = GltfFile(path)
    tree = NodeTree(file)
    meshes = [(node, *_mesh_of(file, tree, node)) for node in tree.in_scene() if "mesh" in tree.nodes[node]]
    skins = {number: _read_skin(file, number) for number in _used_skins(file, meshes)} if meshes else {}
    pieces, reader = [], MeshReader(file)
    with np.errstate(all="ignore"):
        seen = [*(node for node, _, _ in meshes), *(joint for skin in skins.values() for joint in skin.joints)]
        here = {node: world[0] for node, world in tree.worlds(tree.with_ancestors(seen)).items()}
        for node, mesh, number in meshes:
            piece = reader.read(mesh, None if number is None else len(skins[number].joints))
            if number is None:
                piece = moved(piece, here[node])
            else:
                skin = skins[number]
                matrices = np.stack([here[joint] for joint in skin.joints]) @ skin.inverse_bind
                posed = np.zeros_like(piece.vertices)
                for joint, weight in zip(piece.joints.T, piece.weights.T, strict=True):
                    turned = np.einsum("vab,vb->va", matrices[joint, :3, :3], piece.vertices) + matrices[joint, :3, 3]
                    posed += weight[:, None] * turned
                piece = replace(piece, vertices=posed, joints=piece.joints[:, :0], weights=piece.weights[:, :0])
            pieces.append(piece)
        whole = welded(join_pieces(pieces))
    if not np.isfinite(whole.vertices).all():
        file.fail("its vertices are too far away to be numbers; repair it or export it again")
    return whole.vertices, whole.faces


def _mesh_of(file: GltfFile, tree: NodeTree, node: int) -> tuple[int, int | None]:
    """Return mesh and skin of a node."""
    what = f"node {node}"
    return file.index(tree.nodes[node], "mesh", "meshes", what), file.index(tree.nodes[node], "skin", "skins", what)


def _used_skins(file: GltfFile, meshes: list[tuple[int, int, int | None]]) -> list[int]:
    """Return the skins that move a mesh, all skins where there is no mesh; those with the most joints come first."""
    skins = file.items("skins")
    used = dict.fromkeys(skin for _, _, skin in meshes if skin is not None) if meshes else range(len(skins))
    joints = [skins[skin].get("joints") for skin in used]
    counts = dict(zip(used, [len(found) if isinstance(found, list) else 0 for found in joints], strict=True))
    if sum(counts.values()) + 20 * len(counts) > _MAX_SKIN_JOINTS:  # 20: what a skin costs without joints
        file.fail(f"has {len(counts)} skins of {sum(counts.values())} joints, too many; join its meshes")
    return sorted(counts, key=lambda skin: -counts[skin])


def _read_skin(file: GltfFile, number: int) -> _Skin:
    skin, what = file.items("skins")[number], f"skin {number}"
    joints = skin.get("joints")
    if not isinstance(joints, list) or not joints:
        file.fail(f"{what} has no joints; export it again")
    joints = [file.checked_index(joint, "nodes", f"a joint of {what}") for joint in joints]
    if len(set(joints)) < len(joints):
        file.fail(f"{what} names a joint twice; export it again")
    matrices = np.tile(np.eye(4), (len(joints), 1, 1))
    accessor = file.index(skin, "inverseBindMatrices", "accessors", what)
    if accessor is not None:
        stored = file.accessor(accessor, ("MAT4",), f"inverse bind matrices of {what}")
        if len(stored) < len(joints):
            file.fail(f"{what} has {len(joints)} joints and {len(stored)} inverse bind matrices; export it again")
        matrices = stored[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)  # stored by columns
        matrices[:, 3] = 0.0, 0.0, 0.0, 1.0
    _check_transforms(file, matrices, [f"{joint}" for joint in joints], f" in the inverse bind matrices of {what}")
    return _Skin(joints, matrices)


def _sorted_joints(tree: NodeTree, joints: list[int]) -> tuple[list[int], tuple[int, ...]]:
    """Return the joints in the same order, but each after its parent, and the parents; nodes between two joints are skipped."""
    known = set(joints)
    place: dict[int, int] = {}
    parents: list[int] = []
    for joint in joints:
        chain, node = [], joint
        while node >= 0 and node not in place:
            if node in known:
                chain.append(node)
            node = tree.parents[node]
        parent = place.get(node, -1)
        for member in reversed(chain):
            place[member] = len(parents)
            parents.append(parent)
            parent = place[member]
    return list(place), tuple(parents)


def _rest_and_pieces(
    file: GltfFile,
    tree: NodeTree,
    skins: dict[int, _Skin],
    meshes: list[tuple[int, int, int | None]],
    joints: list[int],
    here: dict[int, NDArray[np.float64]],
) -> tuple[NDArray[np.float64], list[Piece]]:
    """Return where the joints are at rest [J, 4, 4], and all triangles there, with numbers of joints as in `joints`.

    Args:
        file: the file.
        tree: its nodes.
        skins: those that are used; none for a robot.
        meshes: node, mesh and skin of each mesh that is shown.
        joints: J nodes.
        here: where nodes stand by default.
    """
    column = {joint: number for number, joint in enumerate(joints)}
    world_from_bind, rest = placed_skins(skins, here)
    if world_from_bind.keys() < skins.keys():
        log.warning("%s: two skins put the same joint in different places; only the first one's mesh is used", file.path.name)
    rest = {joint: rest.get(joint, here[joint]) for joint in joints}
    pieces, left_out, reader = [], 0, MeshReader(file)
    for node, mesh, skin in meshes:
        if skin is not None and skin in world_from_bind:
            piece = reader.read(mesh, len(skins[skin].joints))
            columns = np.array([column[joint] for joint in skins[skin].joints])
            pieces.append(moved(replace(piece, joints=columns[piece.joints]), world_from_bind[skin]))
            continue
        joint = node
        while joint >= 0 and joint not in column:
            joint = tree.parents[joint]
        if skin is not None or joint < 0:
            left_out += 1
            continue
        piece = moved(reader.read(mesh, None), rest[joint] @ np.linalg.inv(here[joint]) @ here[node])
        count = len(piece.vertices)
        pieces.append(replace(piece, joints=np.full((count, 1), column[joint]), weights=np.ones((count, 1))))
    if left_out:
        log.info("%s: %d meshes that no joint moves were left out", file.path.name, left_out)
    return np.stack([rest[joint] for joint in joints]), pieces


def _check_transforms(file: GltfFile, matrices: NDArray[np.float64], names: Iterable[str], where: str) -> None:
    """Refuse matrices [..., J, 4, 4] that are not finite or cannot be inverted."""
    linear = matrices[..., :3, :3]
    size = np.sqrt((linear**2).sum((-1, -2)))
    # The determinant of a turn that scales by s is s^3, and the size s sqrt(3). Flattened to 1e-9 it is as good as zero.
    is_good = np.isfinite(matrices).all((-1, -2)) & (np.abs(np.linalg.det(linear)) > 1e-9 * size**3) & (size > 1e-12)
    if not is_good.all():
        joint = list(names)[int(np.argwhere(~is_good)[0][-1])]
        file.fail(f"joint {joint} has scale zero or is out of all bounds{where}; repair it or export it again")


def _unique(names: Iterable[Any], what: str) -> tuple[str, ...]:
    """Return printable names, each once."""
    found = []
    for number, name in enumerate(names):
        name = "".join(letter if letter.isprintable() else "_" for letter in name[:100]) if isinstance(name, str) else ""
        found.append(name or f"{what}_{number}")
    return tuple(unique_names(found))
