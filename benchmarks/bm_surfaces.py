"""Field surface and skinned surface compared with each other and with the true body, in and out of distribution.

    python benchmarks/bm_surfaces.py          needs `make demo`, or give --avatar and its --subject

The subject is a built-in one, whose posed body is known. "Buried" is the share of the skinned surface that lies deeper than
3 mm inside the field: parts that intersect where the body touches itself; the field has none, since it is their union.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from common import arguments, print_machine, print_table, require

from snarfcli.avatar import Avatar
from snarfcli.datasets.builtin import builtin_subject
from snarfcli.datasets.subjects import SequenceSpec
from snarfcli.evaluation.surface_metrics import compare_surfaces, sample_surface
from snarfcli.meshing.followed import Followed
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.meshing.surfaces import field_surface
from snarfcli.motions import builtin_motion
from snarfcli.progress import progress

_DEEP_M = 0.003
_JUMP_M = 0.005


def main() -> None:
    options = arguments(
        "Field and skinned surface.",
        avatar={"default": "outputs/builtin/50002/demo/avatar.pt", "help": "a trained avatar of a built-in subject"},
        subject={"default": "50002", "help": "whose body is the truth"},
        frames={"type": int, "default": 6, "help": "frames of each sequence, evenly spaced"},
        resolution={"type": int, "default": 256, "help": "voxels along the longest side"},
    )
    avatar = Avatar.load(require(Path(options.avatar), "make demo"))
    skinned = avatar.skinned_surface(options.resolution)
    subject = builtin_subject(options.subject)
    sequences = [sequence for sequence in subject.sequences if sequence.split in ("test", "ood")]
    rows, all_values = [], {"test": [], "ood": []}
    for sequence in progress(sequences, desc="comparing", unit="sequences"):
        frames = np.linspace(0, sequence.motion.num_frames - 1, options.frames).astype(int)
        values = np.array([_compare(avatar, skinned, sequence, int(frame), options.resolution) for frame in frames])
        all_values[sequence.split].append(values)
        rows.append(_row(sequence.name, sequence.split, values))
    for split, values in all_values.items():
        rows.append(_row("all", split, np.concatenate(values)))
    print_machine()
    header = ["sequence", "split", "field to skinned", "field to truth", "skinned to truth", "buried, % (worst)"]
    print("\nChamfer distances in mm\n")
    print_table(header, rows)
    print("\nThe skinned surface follows the shape at control points; vertex motions are between consecutive frames\n")
    header = ["motion, 40 frames", "interpolated, mm off (99 %)", "vertex motions", "over 5 mm", "if every point were believed"]
    print_table(header, [_following(avatar, skinned, name) for name in ("jumping_jacks", "punching")])


def _following(avatar: Avatar, skinned: SkinnedSurface, name: str) -> list[str]:
    """Compare following control points with following every vertex, and count how often vertices jump."""
    motion = builtin_motion(name, 0).slice(stop=40)
    poses = [torch.from_numpy(pose).float() for pose in motion.poses]
    everywhere = Followed(avatar, avatar.skeleton.canonical_pose.float(), skinned.mesh)
    apart, jumps, raw_jumps, total = [], 0, 0, 0
    before = raw_before = None
    for frame, pose in enumerate(poses):
        vertices = skinned.canonical_vertices(pose)
        raw_ways = skinned.spread(skinned.control.nearest_ways(pose)[0]).cpu().numpy()
        raw = skinned.mesh.vertices + raw_ways[:, None] * skinned.mesh.normals
        if frame % 10 == 0:
            wanted = skinned.mesh.vertices + everywhere.ways(pose).cpu().numpy()[:, None] * skinned.mesh.normals
            apart.append(np.linalg.norm(vertices - wanted, axis=1))
        if before is not None:
            jumps += int((np.linalg.norm(vertices - before, axis=1) > _JUMP_M).sum())
            raw_jumps += int((np.linalg.norm(raw - raw_before, axis=1) > _JUMP_M).sum())
            total += len(vertices)
        before, raw_before = vertices, raw
    mm = 1e3 * np.concatenate(apart)
    return [name, f"{mm.mean():.2f} ({np.percentile(mm, 99):.2f})", f"{total:,}", f"{jumps:,}", f"{raw_jumps:,}"]


def _row(name: str, split: str, values: np.ndarray) -> list[str]:
    mean = values.mean(axis=0)
    return [name, split, *(f"{1e3 * value:.2f}" for value in mean[:3]), f"{100 * mean[3]:.1f} ({100 * values[:, 3].max():.1f})"]


def _compare(
    avatar: Avatar, skinned: SkinnedSurface, sequence: SequenceSpec, frame: int, resolution: int
) -> tuple[float, float, float, float]:
    motion = sequence.motion
    pose = torch.from_numpy(motion.poses[frame]).float()
    translation = torch.from_numpy(motion.translation[frame]).float()
    field, moved = field_surface(avatar, pose, translation, resolution), skinned.posed(pose, translation)
    truth = Mesh(*sequence.meshes[frame])
    pairs = ((moved, field), (truth, field), (truth, moved))
    chamfer = [compare_surfaces((a.vertices, a.faces), (b.vertices, b.faces)).chamfer_m for a, b in pairs]
    return *chamfer, _buried(moved, field)


def _buried(mesh: Mesh, field: Mesh) -> float:
    """Return the share of a surface that lies deep inside another, closed surface."""
    import igl

    points, _ = sample_surface(mesh.vertices, mesh.faces, 20_000, np.random.default_rng(0))
    vertices, faces = field.vertices.astype(np.float64), field.faces.astype(np.int64)
    squared = np.asarray(igl.point_mesh_squared_distance(points, vertices, faces)[0]).ravel()
    deep = points[squared > _DEEP_M**2]
    winding = np.asarray(igl.fast_winding_number(vertices, faces, deep)).ravel() if len(deep) else np.zeros(0)
    return float((winding > 0.5).sum() / len(points))


if __name__ == "__main__":
    main()
