"""Avatars from scans without poses: trained on the poses that `snarf fit` finds, and on the true ones.

    python benchmarks/bm_fit_avatar.py FOLDER --training standard      scans, samples, avatars and results go there

Built-in subject 50002 is written as meshes, every fourth frame at 60 per second as for training on `data=builtin`; also of the
out-of-distribution motions, since a fit follows motion, but of these only every 15th is evaluated. The vertices of every frame
are in random order, so that nothing but the surface says what moved where. One copy has the true skeleton and poses, the other
those of `snarf fit`. Both avatars are trained with `refine_poses`, and evaluated with the poses as they are, and with poses
fitted to the held-out meshes (`eval refine_poses=true`); frames that the fit does not trust are left out. The labels are those
of the same meshes, so the rows differ only by the poses.

Every step is skipped if its result is there, so the script may be interrupted. It takes one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
import trimesh
from common import print_machine, print_table

from snarfcli.array_files import read_npz
from snarfcli.bodies import forward_kinematics
from snarfcli.datasets.builtin import builtin_subject

_EVERY = 4  # frames of the motions, as in conf/data/builtin.yaml
_OOD_STEP = 15  # of those that are written, so that every 60th is evaluated
_KINDS = ("true", "fitted")


def write_scans(folder: Path, subject_name: str, motions: list[str]) -> None:
    """Write the meshes of a subject once, and link them into a folder with and one without skeleton and poses."""
    subject = builtin_subject(subject_name)
    true, fitted = (folder / kind / "meshes" / subject_name for kind in _KINDS)
    if (folder / "written").exists():
        return
    sequences = [spec for spec in subject.sequences if not motions or spec.name in motions]
    for spec in sequences:
        (true / spec.name).mkdir(parents=True, exist_ok=True)
        frames = np.arange(0, spec.motion.num_frames, _EVERY)
        np.savez(
            true / spec.name / "poses.npz",
            poses=spec.motion.poses[frames],
            trans=spec.motion.translation[frames],
            frame_rate=spec.motion.frame_rate / _EVERY,
        )
        meshes = spec.meshes.chosen(frames)
        for index in range(len(meshes)):
            vertices, faces = meshes[index]
            order = np.random.default_rng([index, len(spec.name)]).permutation(len(vertices))
            trimesh.Trimesh(vertices[order], np.argsort(order)[faces], process=False).export(
                true / spec.name / f"{index:04}.ply"
            )
    shutil.copytree(true, fitted, copy_function=os.link, ignore=shutil.ignore_patterns("poses.npz"), dirs_exist_ok=True)
    skeleton = subject.skeleton
    np.savez(
        true / "skeleton.npz",
        names=np.array(skeleton.names),
        parents=np.array(skeleton.parents),
        joints_rest=skeleton.joints_rest.numpy(),
        canonical_pose=skeleton.canonical_pose.numpy(),
    )
    split = {kind: [spec.name for spec in sequences if spec.split == kind] for kind in ("test", "ood")}
    for place in (true, fitted):
        (place / "split.json").write_text(json.dumps(split))
    (folder / "written").touch()


def run(folder: Path, kind: str, options: argparse.Namespace) -> list[list[str]]:
    """Fit, sample, train and evaluate one kind of poses; return the rows of the table."""
    place = folder / kind
    settings = ["data=meshes", f"subject={options.subject}", f"data_root={place}"]
    results = [f"output_root={folder / 'outputs' / kind}", f"run={options.training}"]
    avatar = folder / "outputs" / kind / "meshes" / options.subject / options.training
    if kind == "fitted":
        snarf(place / "fitted", "fit", *settings, "workers=1", f"frame_rate={60 // _EVERY}")
    snarf(place / "sampled", "preprocess", *settings, "workers=1", f"data.ood_frame_step={_OOD_STEP}")
    trained = ["train", *settings, *results, f"training={options.training}", "training.refine_poses=true", "threads=1"]
    snarf(avatar / "trained", *trained, "device=cpu", "resume=true")
    rows = []
    for split in ("id", "ood"):
        row = [kind, split]
        for refined in ("false", "true"):
            name = f"eval_{split}" + ("_refined" if refined == "true" else "")
            evaluated = ["eval", *settings, *results, f"split={split}", f"refine_poses={refined}", "figure=false", "threads=1"]
            snarf(avatar / f"{name}_done", *evaluated, "device=cpu")
            metrics = json.loads((avatar / name / "metrics.json").read_text())
            row += [str(metrics["frames"])] if refined == "false" else []
            row += [f"{100 * metrics['iou_bbox']:.2f}", f"{100 * metrics['iou_surface']:.2f}"]
        rows.append(row)
    return rows


def snarf(done: Path, *arguments: str) -> None:
    """Run a command unless the file `done` says that it has ended well; it then holds the seconds that it took."""
    if done.exists():
        return
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    start = time.monotonic()
    if subprocess.run([sys.executable, "-m", "snarfcli", *arguments], env=environment, check=False).returncode:
        raise SystemExit(f"snarf {' '.join(arguments)} failed")
    done.write_text(f"{time.monotonic() - start:.0f}\n")


def joint_errors_mm(folder: Path, subject_name: str) -> tuple[float, float, float]:
    """Return the mean error of fitted joints, millimetres, the share of frames below 15, and the share of trusted frames."""
    true, fitted = (folder / kind / "meshes" / subject_name for kind in _KINDS)
    errors, trusted = [], []
    for path in sorted(fitted.glob("*/poses.npz")):
        name = path.parent.name
        joints = [_joints(read_npz(place / "skeleton.npz"), read_npz(place / name / "poses.npz")) for place in (true, fitted)]
        errors.append(1000 * np.linalg.norm(joints[0] - joints[1], axis=-1).mean(axis=1))
        trusted.append(read_npz(path)["trusted"])
    error = np.concatenate(errors)
    return float(error.mean()), float((error < 15).mean()), float(np.concatenate(trusted).mean())


def _joints(skeleton: dict[str, np.ndarray], motion: dict[str, np.ndarray]) -> np.ndarray:
    """Return the posed joints [T, J, 3], metres."""
    rest = torch.from_numpy(np.asarray(skeleton["joints_rest"], np.float64))
    poses, shift = (torch.from_numpy(np.asarray(motion[name], np.float64)) for name in ("poses", "trans"))
    parents = tuple(int(parent) for parent in skeleton["parents"])
    return forward_kinematics(poses.reshape(len(poses), len(parents), 3), rest, parents, shift)[0].numpy()


def main() -> None:
    """Train and evaluate both avatars, and print their IoU."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--subject", default="50002", help="built-in subject (default: 50002)")
    parser.add_argument("--training", default="standard", help="preset (default: standard)")
    parser.add_argument("--motions", nargs="*", default=[], help="built-in motions, some of each split (default: all)")
    options = parser.parse_args()
    options.folder = options.folder.absolute()
    write_scans(options.folder, options.subject, options.motions)
    rows = [row for kind in _KINDS for row in run(options.folder, kind, options)]
    print_machine()
    columns = ["poses", "split", "frames", "IoU bbox, %", "IoU surface, %", "bbox, refined, %", "surface, refined, %"]
    print_table(columns, rows)
    mean, share, trusted = joint_errors_mm(options.folder, options.subject)
    shares = f"{100 * share:.1f} % of frames under 15 mm, {100 * trusted:.1f} % trusted"
    print(f"fitted poses: mean joint error {mean:.1f} mm, {shares}")


if __name__ == "__main__":
    main()
