"""Read glTF 2.0 files (`.glb`, `.gltf`, VRM's `.vrm` and `.vrma`): skinned characters, robots of rigid parts, static meshes.

Source: Khronos, glTF 2.0 specification.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.gltf_clips import printable_names, sample_clips
from snarfcli.formats.gltf_file import GltfFile
from snarfcli.formats.gltf_humanoid import read_humanoid
from snarfcli.formats.gltf_mesh import MeshReader, Piece, dense_weights, join_pieces, moved, welded
from snarfcli.formats.gltf_motion import GltfAnimation, read_animations
from snarfcli.formats.gltf_nodes import NodeTree, ShownMesh
from snarfcli.formats.gltf_place import placed_skins
from snarfcli.formats.gltf_skin import Skin, check_transforms, read_used_skins
from snarfcli.formats.rig import Rig, RigMesh
from snarfcli.texts import counted

__all__ = ["GLTF_SUFFIXES", "read_gltf", "read_gltf_surface"]

GLTF_SUFFIXES = (".glb", ".gltf", ".vrm", ".vrma")
"""Suffixes of glTF files with joints, in lower case; those of VRM are `.glb` files with a table of the body's bones."""

log = logging.getLogger(__name__)

_LISTED = 4  # clips in a message


def read_gltf(path: str | Path, *, frame_rate: float | None = None) -> Rig:
    """Read the joints, the motions and the mesh of a file ending in one of `GLTF_SUFFIXES`.

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
    - The bones of a humanoid in a VRM file become joints in any case; without skin and mesh (`.vrma`), they alone.
    - Damaged animations are left out, unless all are. A joint that an animation hides by the scale 0 has the scale 1e-4 there.

    Args:
        path: the file; its buffers lie inside it or beside it.
        frame_rate: frames per second at which animations are sampled, from the first key to the last; None for the rate of each
            animation (`extras.frame_rate`, as this package writes it, or that of equally spaced keys), or 30 if it has none.

    Raises:
        UserError: the file is missing, damaged, compressed (Draco, meshopt) or too large, contains nothing that moves, or has
            only joints of scale zero.
        ValueError: `frame_rate` is not positive.
    """
    if frame_rate is not None and not frame_rate > 0:
        raise ValueError(f"frame_rate: wanted a positive number, got {frame_rate}")
    file = GltfFile(path)
    tree = NodeTree(file)
    animations, damaged = read_animations(file, frame_rate)
    meshes = tree.shown_meshes()
    skins = read_used_skins(file, meshes)
    humanoid = read_humanoid(file)
    with np.errstate(all="ignore"):  # overflow is found by check_transforms
        joints, parents = _sorted_joints(tree, _find_joints(file, tree, skins, meshes, animations, humanoid))
        names = printable_names((tree.nodes[joint].get("name") for joint in joints), "joint")
        relevant = tree.with_ancestors([*joints, *(mesh.node for mesh in meshes)])
        here, hidden = _worlds_by_default(file, tree, relevant, joints, names)
        rest, pieces = _rest_and_pieces(file, tree, skins, meshes, joints, here, hidden)
        check_transforms(file, rest, names, " at rest")
        clips, unusable = sample_clips(file, tree, animations, joints, names)
        mesh = _rig_mesh(file, pieces, len(joints))
    left_out = (*damaged, *unusable)
    _report_left_out(file, left_out, len(clips))
    place = {node: joint for joint, node in enumerate(joints)}
    return Rig(names, parents, rest, clips, mesh, {bone: place[node] for bone, node in humanoid.items()}, left_out)


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
    file: GltfFile,
    tree: NodeTree,
    skins: dict[int, Skin],
    meshes: list[ShownMesh],
    animations: list[GltfAnimation],
    humanoid: dict[str, int],
) -> list[int]:
    """Return the nodes that become joints: those of skins and humanoid; without skins, also those that hold or move a mesh."""
    bones = list(humanoid.values())
    if skins:
        return list(dict.fromkeys([*(joint for skin in skins.values() for joint in skin.joints), *bones]))
    holders = {mesh.node for mesh in meshes}
    # Other nodes of an animation without a mesh hold expressions or the direction of the eyes.
    moving = {node for animation in animations for node in animation.nodes} if holders or not bones else set()
    wanted = {*holders, *moving, *bones}
    joints = [node for node in tree.with_ancestors([*(holders or moving), *bones]) if node in wanted]
    if not joints:
        file.fail("has no skin, no mesh and no animation; give the file of a rigged character")
    return joints


def _worlds_by_default(
    file: GltfFile, tree: NodeTree, relevant: list[int], joints: list[int], names: tuple[str, ...]
) -> tuple[dict[int, NDArray[np.float64]], set[int]]:
    """Return the transforms [4, 4] from nodes to the world, and the joints that are hidden by the scale 0.

    Raises:
        UserError: all joints have the scale 0, or a transform is not finite.
    """
    stored = {node: world[0] for node, world in tree.worlds(relevant).items()}
    hidden = {joint for joint in joints if np.linalg.det(stored[joint][:3, :3]) == 0}
    if len(hidden) in (0, len(joints)):
        check_transforms(file, np.stack([stored[joint] for joint in joints]), names, "")
        return stored, hidden
    here = {node: world[0] for node, world in tree.worlds(relevant, keep_zero=False).items()}
    check_transforms(file, np.stack([here[joint] for joint in joints]), names, "")
    return here, hidden


def _report_left_out(file: GltfFile, left_out: Sequence[tuple[str, str]], num_clips: int) -> None:
    """Log the clips that were left out; raise UserError if there are no others."""
    if not left_out:
        return
    if not num_clips:
        file.fail(left_out[0][1])
    shown = "; ".join(f"{name[:40]!a}: {reason}" for name, reason in left_out[:_LISTED])
    log.warning("%s: left out %s that cannot be used (%s)", file.path.name, counted(len(left_out), "motion"), shown)


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
    hidden: set[int],
) -> tuple[NDArray[np.float64], list[Piece]]:
    """Return the transforms [J, 4, 4] of the joints at rest, and all triangles at rest, which follow indices into `joints`.

    Args:
        file: the file.
        tree: its nodes.
        skins: the used skins by index; empty for a robot of rigid parts.
        meshes: the meshes of the default scene.
        joints: J node indices.
        here: [4, 4] per node, transform from the node to the world by default.
        hidden: joints whose scale is 0 by default.
    """
    column = {joint: number for number, joint in enumerate(joints)}
    world_from_bind, rest = placed_skins(skins, here, hidden)
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
        log.info("%s: left out %s without a joint", file.path.name, counted(left_out, "mesh", "meshes"))
    return np.stack([rest[joint] for joint in joints]), pieces
