"""Field surface against skinned surface, and both against the true body, in and out of distribution.

    python benchmarks/bm_surfaces.py          needs `make demo`, or give --avatar and its --subject

The subject is a built-in one, whose posed body is known. "Buried" is the share of the skinned surface that lies deeper than
3 mm inside the field: parts that pass into each other where the body touches itself, which the field's union does not have.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from common import arguments, print_machine, print_table, require

from snarfcli.datasets.builtin import builtin_subject
from snarfcli.evaluation.surface_metrics import compare_surfaces, sample_surface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import field_surface
from snarfcli.models.avatar import Avatar
from snarfcli.progress import progress

_DEEP_M = 0.003


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


def _row(name: str, split: str, values: np.ndarray) -> list[str]:
    mean = values.mean(axis=0)
    return [name, split, *(f"{1e3 * value:.2f}" for value in mean[:3]), f"{100 * mean[3]:.1f} ({100 * values[:, 3].max():.1f})"]


def _compare(avatar: Avatar, skinned, sequence, frame: int, resolution: int) -> tuple[float, float, float, float]:
    motion = sequence.motion
    pose = torch.from_numpy(motion.poses[frame]).float()
    translation = torch.from_numpy(motion.translation[frame]).float()
    field, moved = field_surface(avatar, pose, translation, resolution), skinned.posed(pose, translation)
    truth = Mesh(*sequence.meshes[frame])
    pairs = ((moved, field), (truth, field), (truth, moved))
    chamfer = [compare_surfaces((a.vertices, a.faces), (b.vertices, b.faces)).chamfer_m for a, b in pairs]
    return *chamfer, _buried(moved, field)


def _buried(mesh: Mesh, field: Mesh) -> float:
    """Return the share of a surface that lies deep inside another, closed one."""
    import igl

    points, _ = sample_surface(mesh.vertices, mesh.faces, 20_000, np.random.default_rng(0))
    vertices, faces = field.vertices.astype(np.float64), field.faces.astype(np.int64)
    squared = np.asarray(igl.point_mesh_squared_distance(points, vertices, faces)[0]).ravel()
    deep = points[squared > _DEEP_M**2]
    winding = np.asarray(igl.fast_winding_number(vertices, faces, deep)).ravel() if len(deep) else np.zeros(0)
    return float((winding > 0.5).sum() / len(points))


if __name__ == "__main__":
    main()
