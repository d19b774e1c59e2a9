"""Samples with noisy poses, as from markerless capture: how wrong they are, and how much of the error a refinement removes.

    python benchmarks/bm_noisy_poses.py data noisy/data --subjects 50002 50004 --degrees 5 --shift 0.02 --seed 0

Copies processed built-in samples from one data_root to another. Points, labels and meshes stay; poses, translations, bone
transforms and joints are those of the noisy poses. The true poses are kept in `true_poses.npz` in the folder of each subject.

    snarf train subject=50002 training=quick training.refine_poses=true data_root=noisy/data run=refined
    snarf eval subject=50002 refine_poses=true data_root=noisy/data run=refined
    python benchmarks/bm_noisy_poses.py data noisy/data --refined outputs/builtin/50002/refined/refined_poses.npz

The last command compares the refined poses with the true ones instead of writing samples.

Noise, independent per frame: the local rotation of every joint, the root included, is followed (in the axes of the rotated
joint) by a rotation whose vector has three normal components, with a standard deviation for which the mean angle is `--degrees`
(the rms angle is 1.085 times as large); the translation is shifted by a normal vector whose rms length is `--shift`.
"""

from __future__ import annotations

import argparse
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from common import print_table, require
from torch import Tensor

from snarfcli.array_files import read_npz
from snarfcli.bodies import Skeleton, axis_angle_to_matrix, invert_rigid, matrix_to_axis_angle
from snarfcli.bodies.kinematics import nearest_rotation
from snarfcli.datasets.splits import SPLITS
from snarfcli.files import read_json, write_arrays, write_json
from snarfcli.samples.layout import read_arrays, samples_folder
from snarfcli.samples.store import SampleStore
from snarfcli.samples.writing import describe_files

__all__ = ["PoseErrors", "add_noise", "pose_errors", "read_true_poses", "write_noisy_samples"]

_TRUE_POSES = "true_poses.npz"
# Mean length of a vector of three normal components with standard deviation 1 (Maxwell distribution).
_MEAN_LENGTH = 2 * np.sqrt(2 / np.pi)
_TOLERANCE = 1e-4  # of the entries of a bone transform: poses within it reproduce the stored float32 transforms


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Differences of estimated poses from true ones, without the part that is the same in every frame."""

    angles_deg: Tensor
    """[J], mean angle over the frames between the local rotations of a joint, degrees."""
    joints_m: Tensor
    """[J], mean distance over the frames between posed joints, metres."""

    def row(self) -> list[str]:
        """Return mean and largest angle of the joints, and mean and largest distance, as text for a table."""
        angles, joints = self.angles_deg, 100 * self.joints_m
        return [f"{angles.mean():.2f}", f"{angles.max():.2f}", f"{joints.mean():.2f}", f"{joints.max():.2f}"]


def add_noise(poses: Tensor, translation: Tensor, degrees: float, shift_m: float, seed: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return noisy poses and translations.

    Args:
        poses: [T, J, 3], axis-angle, radians, float64.
        translation: [T, 3], metres, float64.
        degrees: mean angle of the rotation that is added to each joint.
        shift_m: rms length of the vector that is added to the translation, metres.
        seed: of the random numbers; sequences need different ones.
    """
    random = np.random.default_rng(seed)
    turns = torch.from_numpy(random.normal(0.0, np.deg2rad(degrees) / _MEAN_LENGTH, poses.shape))
    shifts = torch.from_numpy(random.normal(0.0, shift_m / np.sqrt(3), translation.shape))
    return matrix_to_axis_angle(axis_angle_to_matrix(poses) @ axis_angle_to_matrix(turns)), translation + shifts


def pose_errors(
    skeleton: Skeleton, estimated: tuple[Tensor, Tensor], true: tuple[Tensor, Tensor], frames: Tensor | None = None
) -> PoseErrors:
    """Compare estimated poses with true ones.

    A bone that is turned or moved by the same amount in every frame does no harm, since the avatar can be learned with it. So
    this common part is removed: the mean difference of the posed bones, per joint and in the axes of the bone.

    Args:
        skeleton: skeleton of the subject.
        estimated: poses [T, J, 3], axis-angle, radians, and translation [T, 3], metres; of all sequences together.
        true: the same frames with the true poses.
        frames: [K], indices of the frames to compare; all by default.
    """
    poses, joints = zip(*(_posed_bones(skeleton, *both, frames) for both in (estimated, true)), strict=True)
    common = nearest_rotation((poses[1].mT @ poses[0]).mean(0))  # [J, 3, 3], estimated bone to true bone
    without = poses[0] @ common.mT
    local = [_local_rotations(rotations, skeleton.parents) for rotations in (without, poses[1])]
    angles = matrix_to_axis_angle(local[1].mT @ local[0]).norm(dim=-1)
    apart = (poses[1].mT @ (joints[0] - joints[1])[..., None]).squeeze(-1)
    return PoseErrors(torch.rad2deg(angles.mean(0)), (apart - apart.mean(0)).norm(dim=-1).mean(0))


def _posed_bones(skeleton: Skeleton, poses: Tensor, translation: Tensor, frames: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the global rotations [T, J, 3, 3] and the joints [T, J, 3] of poses, float64."""
    if frames is not None:
        poses, translation = poses[frames], translation[frames]
    skeleton = skeleton.to(torch.float64)
    moved = skeleton.posed_from_rest(poses.double(), translation.double())
    joints = torch.einsum("tjrc,jc->tjr", moved[..., :3, :3], skeleton.joints_rest) + moved[..., :3, 3]
    return moved[..., :3, :3], joints


def _local_rotations(rotations: Tensor, parents: Sequence[int]) -> Tensor:
    """Return rotations [T, J, 3, 3] relative to those of the parents."""
    above = [torch.eye(3, dtype=rotations.dtype).expand(len(rotations), 3, 3) if p < 0 else rotations[:, p] for p in parents]
    return torch.stack(above, 1).mT @ rotations


def write_noisy_samples(
    source: Path,
    target: Path,
    data: str,
    subject: str,
    degrees: float,
    shift_m: float,
    seed: int,
    splits: Sequence[str] = SPLITS,
) -> None:
    """Copy the samples of one subject, with noise in the poses of the given splits.

    Args:
        source: data_root of the samples.
        target: data_root of the copy; the subject must not exist there.
        data: name of the data set.
        subject: name of the subject.
        degrees: mean angle of the noise of each joint.
        shift_m: rms length of the noise of the translation, metres.
        seed: of the noise.
        splits: splits that get noise; others are copied unchanged.

    Raises:
        SystemExit: the target exists, or the poses do not reproduce the bone transforms of the samples.
    """
    store = SampleStore.open(source, data, subject)
    folder = samples_folder(target, data, subject)
    if folder.exists():
        raise SystemExit(f"{folder} exists; delete it, or name another data_root")
    shutil.copytree(store.folder, folder, ignore=shutil.ignore_patterns("manifest.json"))
    noise = {"mean_angle_deg": degrees, "rms_shift_m": shift_m, "seed": seed, "splits": list(splits)}
    true: dict[str, np.ndarray] = {}
    manifest = read_json(store.folder / "manifest.json")
    for entry, sequence in zip(manifest["sequences"], store.all_sequences, strict=True):
        name = f"{sequence.split}/{sequence.name}"
        true[f"{name}/poses"], true[f"{name}/translation"] = sequence.poses, sequence.translation
        if sequence.split not in splits:
            continue
        poses, translation = (torch.from_numpy(array).double() for array in (sequence.poses, sequence.translation))
        again = _frame_arrays(store.skeleton, poses, translation)["posed_from_canonical"]
        if np.abs(again - sequence.bone_transforms).max() > _TOLERANCE:
            raise SystemExit(f"{sequence.folder}: the poses do not reproduce the bone transforms; use samples of a body model")
        key = [seed, zlib.crc32(f"{data}/{subject}/{name}".encode())]
        noisy = _frame_arrays(store.skeleton, *add_noise(poses, translation, degrees, shift_m, key))
        place = folder / name
        write_arrays(place / "frames.npz", {**read_arrays(place / "frames.npz"), **noisy})
        described = describe_files(place, ["frames.npz"])
        description = read_json(place / "sequence.json")
        for content in (entry, description):
            content["pose_noise"] = noise
            content["files"] |= described
        write_json(place / "sequence.json", description)
    write_arrays(folder / _TRUE_POSES, true)
    write_json(folder / "manifest.json", manifest | {"pose_noise": noise})


def _frame_arrays(skeleton: Skeleton, poses: Tensor, translation: Tensor) -> dict[str, np.ndarray]:
    """Return the arrays of `frames.npz` that depend on the poses, float32, as `snarf preprocess` computes them."""
    skeleton = skeleton.to(torch.float64)
    moved = skeleton.posed_from_rest(poses, translation)
    joints = torch.einsum("tjrc,jc->tjr", moved[..., :3, :3], skeleton.joints_rest) + moved[..., :3, 3]
    transforms = moved @ invert_rigid(skeleton.posed_from_rest(skeleton.canonical_pose[None]))
    arrays = {"poses": poses, "translation": translation, "posed_from_canonical": transforms, "joints": joints}
    return {name: array.numpy().astype(np.float32) for name, array in arrays.items()}


def read_true_poses(root: Path, data: str, subject: str, split: str, name: str) -> tuple[Tensor, Tensor]:
    """Return the true poses [T, J, 3] and translation [T, 3] of a sequence, float64, from the folder of noisy samples.

    Raises:
        UserError: the file is missing or damaged.
    """
    keys = [f"{split}/{name}/poses", f"{split}/{name}/translation"]
    arrays = read_npz(samples_folder(root, data, subject) / _TRUE_POSES, "file of true poses", only=keys)
    return torch.from_numpy(arrays[keys[0]]).double(), torch.from_numpy(arrays[keys[1]]).double()


def _stored_errors(root: Path, data: str, subject: str, split: str) -> PoseErrors:
    """Return the errors of the poses that are stored with noisy samples, over all frames of a split."""
    store = SampleStore.open(root, data, subject)
    sequences = store.sequences(split)
    stored = [(torch.from_numpy(entry.poses), torch.from_numpy(entry.translation)) for entry in sequences]
    true = [read_true_poses(root, data, subject, split, entry.name) for entry in sequences]
    together = [(torch.cat([p for p, _ in pairs]), torch.cat([t for _, t in pairs])) for pairs in (stored, true)]
    return pose_errors(store.skeleton, together[0], together[1])


def _refined_errors(root: Path, data: str, subject: str, refined: Path) -> PoseErrors:
    """Return the errors of the poses that a training run has refined, over all training frames."""
    store = SampleStore.open(root, data, subject)
    arrays = read_npz(refined, "file of refined poses", only=["poses", "trans"])
    found = torch.from_numpy(arrays["poses"]), torch.from_numpy(arrays["trans"])
    true = [read_true_poses(root, data, subject, "train", entry.name) for entry in store.sequences("train")]
    return pose_errors(store.skeleton, found, (torch.cat([p for p, _ in true]), torch.cat([t for _, t in true])))


def main() -> None:
    """Write noisy samples, check their files, and print how wrong their poses are; or compare refined poses with true ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="data_root with the processed samples")
    parser.add_argument("target", type=Path, help="data_root of the noisy copy")
    parser.add_argument("--data", default="builtin", help="data set (default: builtin)")
    parser.add_argument("--subjects", nargs="+", default=["50002"], help="subjects (default: 50002)")
    parser.add_argument("--degrees", type=float, default=5.0, help="mean angle of the noise of each joint (default: 5)")
    parser.add_argument(
        "--shift", type=float, default=0.02, help="rms length of the noise of the translation, metres (default: 0.02)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    parser.add_argument("--splits", nargs="+", choices=SPLITS, default=list(SPLITS), help="splits with noise (default: all)")
    parser.add_argument("--refined", type=Path, help="refined_poses.npz of a run on the noisy samples of the first subject")
    options = parser.parse_args()
    rows = []
    if options.refined is not None:
        errors = _refined_errors(options.target, options.data, options.subjects[0], options.refined)
        rows.append([options.subjects[0], "train, refined", *errors.row()])
        options.subjects = []
    for subject in options.subjects:
        place = samples_folder(options.source, options.data, subject) / "manifest.json"
        require(place, f"snarf preprocess data={options.data} subject={subject} data_root={options.source}")
        noise = (options.degrees, options.shift, options.seed, options.splits)
        write_noisy_samples(options.source, options.target, options.data, subject, *noise)
        store = SampleStore.open(options.target, options.data, subject)
        store.verify()
        for split in dict.fromkeys(sequence.split for sequence in store.all_sequences):
            rows.append([subject, split, *_stored_errors(options.target, options.data, subject, split).row()])
    print_table(["subject", "split", "angle, degrees", "worst joint", "joints, cm", "worst joint, cm"], rows)


if __name__ == "__main__":
    main()
