"""Read glTF 2.0 files (`.glb`, `.gltf`): skinned characters, robots of rigid parts, and static meshes.

Source: Khronos, glTF 2.0 specification.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.gltf_file import GltfFile
from snarfcli.formats.gltf_mesh import MeshReader, Piece, dense_weights, join_pieces, moved, welded
from snarfcli.formats.gltf_motion import GltfAnimation, read_animations
from snarfcli.formats.gltf_nodes import NodeTree, ShownMesh
from snarfcli.formats.gltf_place import placed_skins
from snarfcli.formats.gltf_skin import Skin, check_transforms, read_used_skins
from snarfcli.formats.rig import Rig, RigClip, RigMesh
from snarfcli.names import unique_names

__all__ = ["read_gltf", "read_gltf_surface"]

log = logging.getLogger(__name__)

# Transforms of nodes in one clip, and of joints in all clips, 128 bytes each.
_MAX_NODE_FRAMES = 1_500_000
_MAX_JOINT_FRAMES = 2_000_000
_NODE_COST = 20  # frames; a node costs as much even if it does not move


def read_gltf(path: str | Path, *, frame_rate: float | None = None) -> Rig:
    """Read the joints, the motions and the mesh of a `.glb` or `.gltf` file.

    Frames. The joint of a skin moves a stored vertex by `world_from_joint(t) @ inverse_bind`; the transform of the node that
    holds a skinned mesh is ignored (glTF 2.0, 3.7.3.3). The frame in which a mesh is stored is the exporter's choice: often the
    world, often centimetres with z up below a node that scales by 0.01. One matrix `world_from_bind` maps it to the world:
    `rest = world_from_bind @ inv(inverse_bind)`, and the vertices likewise, so `world_from_joint(t) @ inv(rest)` does not
    change. If the nodes stand in the bind pose, as in most files, that matrix is known exactly, and `rest` is the transforms of
    the nodes; otherwise it has their scale and the nearest rotation by quarter turns.

    - Joints are those of the skins in the default scene, in the order of the file, each after its parent. Nodes between two
      joints, or above the first, are part of the joints' motion. Names are made unique.
    - All triangles of the skins form one mesh, together with unskinned nodes below a joint, which follow it rigidly. Other
      unskinned meshes are left out. Vertices that were split along seams are welded if position and weights are bitwise equal.
      Morph targets, materials and textures are ignored.
    - In a file without skins, each node that has or moves a mesh becomes a joint, and the mesh follows it rigidly.

    Args:
        path: the file; its buffers lie inside it or beside it.
        frame_rate: frames per second at which animations are sampled, from the first key to the last; None for the rate of each
            animation (`extras.frame_rate`, as this package writes it, or that of equally spaced keys), or 30 if it has none.

    Raises:
        UserError: the file is missing, damaged, compressed (Draco, meshopt) or too large, contains nothing that moves, or has
            joints of scale zero.
        ValueError: `frame_rate` is not positive.
    """
    if frame_rate is not None and not frame_rate > 0:
        raise ValueError(f"frame_rate: wanted a positive number, got {frame_rate}")
    file = GltfFile(path)
    tree = NodeTree(file)
    animations = read_animations(file, frame_rate)
    meshes = tree.shown_meshes()
    skins = read_used_skins(file, meshes)
    with np.errstate(all="ignore"):  # overflow is found by check_transforms
        joints, parents = _sorted_joints(tree, _find_joints(file, tree, skins, meshes, animations))
        names = _unique((tree.nodes[joint].get("name") for joint in joints), "joint")
        relevant = tree.with_ancestors([*joints, *(mesh.node for mesh in meshes)])
        here = {node: world[0] for node, world in tree.worlds(relevant).items()}
        check_transforms(file, np.stack([here[joint] for joint in joints]), names, "")
        rest, pieces = _rest_and_pieces(file, tree, skins, meshes, joints, here)
        check_transforms(file, rest, names, " at rest")
        clips = _sample_clips(file, tree, animations, joints, names)
        mesh = _rig_mesh(file, pieces, len(joints))
    return Rig(names, parents, rest, clips, mesh)


def read_gltf_surface(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read all triangles of the default scene in the pose of its nodes, skins included, welded by position.

    Returns:
        vertices: [V, 3], world frame.
        faces: [F, 3]; F may be 0.

    Raises:
        UserError: the file is missing, damaged, compressed (Draco, meshopt) or too large.
    """
    file = GltfFile(path)
    tree = NodeTree(file)
    meshes = tree.shown_meshes()
    skins = read_used_skins(file, meshes) if meshes else {}
    reader = MeshReader(file)
    with np.errstate(all="ignore"):
        seen = [*(mesh.node for mesh in meshes), *(joint for skin in skins.values() for joint in skin.joints)]
        here = {node: world[0] for node, world in tree.worlds(tree.with_ancestors(seen)).items()}
        pieces = []
        for shown in meshes:
            if shown.skin is None:
                pieces.append(moved(reader.read(shown.mesh, None), here[shown.node]))
            else:
                skin = skins[shown.skin]
                matrices = np.stack([here[joint] for joint in skin.joints]) @ skin.inverse_bind
                pieces.append(_posed(reader.read(shown.mesh, len(skin.joints)), matrices))
        whole = welded(join_pieces(pieces))
    _check_vertices(file, whole)
    return whole.vertices, whole.faces


def _posed(piece: Piece, matrices: NDArray[np.float64]) -> Piece:
    """Pose a piece by linear blend skinning with the transforms [J, 4, 4] of its joints; the result follows no joints."""
    posed = np.zeros_like(piece.vertices)
    for joint, weight in zip(piece.joints.T, piece.weights.T, strict=True):
        turned = np.einsum("vab,vb->va", matrices[joint, :3, :3], piece.vertices) + matrices[joint, :3, 3]
        posed += weight[:, None] * turned
    return replace(piece, vertices=posed, joints=piece.joints[:, :0], weights=piece.weights[:, :0])


def _find_joints(
    file: GltfFile, tree: NodeTree, skins: dict[int, Skin], meshes: list[ShownMesh], animations: list[GltfAnimation]
) -> list[int]:
    """Return the nodes that become joints: those of the skins; without skins, those that hold or move a mesh."""
    if skins:
        return list(dict.fromkeys(joint for skin in skins.values() for joint in skin.joints))
    holders = {mesh.node for mesh in meshes}
    moving = {node for animation in animations for node in animation.nodes}
    joints = [node for node in tree.with_ancestors(holders or moving) if node in holders or node in moving]
    if not joints:
        file.fail("has no skin, no mesh and no animation; give the file of a rigged character")
    return joints


def _sample_clips(
    file: GltfFile, tree: NodeTree, animations: list[GltfAnimation], joints: list[int], names: tuple[str, ...]
) -> tuple[RigClip, ...]:
    """Return the world transforms of the joints in each animation."""
    relevant, joint_frames, clips = tree.with_ancestors(joints), 0, []
    clip_names = _unique((animation.name for animation in animations), "clip")
    for name, animation in zip(clip_names, animations, strict=True):
        joint_frames += (animation.num_frames + _NODE_COST) * len(joints)
        if (animation.num_frames + _NODE_COST) * len(relevant) > _MAX_NODE_FRAMES or joint_frames > _MAX_JOINT_FRAMES:
            file.fail(f"its animations have too many frames for {len(relevant)} nodes; export fewer, or cut them")
        worlds = tree.worlds(relevant, animation.nodes)
        poses = np.empty((animation.num_frames, len(joints), 4, 4))
        for column, joint in enumerate(joints):
            poses[:, column] = worlds[joint]
        check_transforms(file, poses, names, f" in clip {name}")
        clips.append(RigClip(name, animation.frame_rate, poses))
    return tuple(clips)


def _rig_mesh(file: GltfFile, pieces: list[Piece], num_joints: int) -> RigMesh | None:
    """Return all pieces as one mesh with weights; None if there are no triangles."""
    whole = welded(join_pieces(pieces))
    if not len(whole.faces):
        return None
    _check_vertices(file, whole)
    return RigMesh(whole.vertices, whole.faces, dense_weights(file, whole, num_joints))


def _check_vertices(file: GltfFile, piece: Piece) -> None:
    if not np.isfinite(piece.vertices).all():
        file.fail("the coordinates of its vertices overflow; repair it or export it again")


def _sorted_joints(tree: NodeTree, joints: list[int]) -> tuple[list[int], tuple[int, ...]]:
    """Return the joints, each after its parent and otherwise in the given order, and the index of each one's parent.

    Nodes between two joints are skipped.
    """
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
    skins: dict[int, Skin],
    meshes: list[ShownMesh],
    joints: list[int],
    here: dict[int, NDArray[np.float64]],
) -> tuple[NDArray[np.float64], list[Piece]]:
    """Return the transforms [J, 4, 4] of the joints at rest, and all triangles at rest, which follow indices into `joints`.

    Args:
        file: the file.
        tree: its nodes.
        skins: the used skins by index; empty for a robot of rigid parts.
        meshes: the meshes of the default scene.
        joints: J node indices.
        here: [4, 4] per node, transform from the node to the world by default.
    """
    column = {joint: number for number, joint in enumerate(joints)}
    world_from_bind, rest = placed_skins(skins, here)
    if world_from_bind.keys() < skins.keys():
        log.warning(
            "%s: two skins have different rest transforms for the same joint; only the mesh of the first skin is used",
            file.path.name,
        )
    rest = {joint: rest.get(joint, here[joint]) for joint in joints}
    pieces, left_out, reader = [], 0, MeshReader(file)
    for shown in meshes:
        if shown.skin is not None and shown.skin in world_from_bind:
            skin_joints = skins[shown.skin].joints
            piece = reader.read(shown.mesh, len(skin_joints))
            columns = np.array([column[joint] for joint in skin_joints])
            pieces.append(moved(replace(piece, joints=columns[piece.joints]), world_from_bind[shown.skin]))
            continue
        joint = shown.node
        while joint >= 0 and joint not in column:
            joint = tree.parents[joint]
        if shown.skin is not None or joint < 0:
            left_out += 1
            continue
        piece = moved(reader.read(shown.mesh, None), rest[joint] @ np.linalg.inv(here[joint]) @ here[shown.node])
        count = len(piece.vertices)
        pieces.append(replace(piece, joints=np.full((count, 1), column[joint]), weights=np.ones((count, 1))))
    if left_out:
        log.info("%s: %d meshes without a joint were left out", file.path.name, left_out)
    return np.stack([rest[joint] for joint in joints]), pieces


def _unique(names: Iterable[Any], what: str) -> tuple[str, ...]:
    """Return the names as unique, printable text; items that are not text get the name `<what>_<index>`."""
    found = []
    for number, name in enumerate(names):
        name = "".join(letter if letter.isprintable() else "_" for letter in name[:100]) if isinstance(name, str) else ""
        found.append(name or f"{what}_{number}")
    return tuple(unique_names(found))
