"""Fit the built-in body to points without poses, and compare the joints with the true ones.

    python benchmarks/bm_fit.py RESULTS.jsonl                            the table of what is there; --run fits what is missing
    python benchmarks/bm_fit.py RESULTS.jsonl --run --rows naked clothed --subjects 50002 --motions splits --part 1/2
    python benchmarks/bm_fit.py RESULTS.jsonl --run --rows real --motion-folder FOLDER --body BODY.npz

Every sequence becomes one line of RESULTS.jsonl when it is done; a run continues where an earlier one ended. A scan has 4,000
unordered points with normals. Pose, place and shape are unknown, and the finder knows no motion of the sequence's name. A
sequence is lost if more than 20 % of its frames have a mean joint error over 50 mm. About 0.3 s of processor time per frame.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from common import print_machine, print_table
from numpy.typing import NDArray

from snarfcli.bodies import Body, builtin_body, load_body
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, builtin_subject
from snarfcli.datasets.clothed import clothed_subject
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, builtin_motion, read_motion
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.same_topology import fit_one_topology
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior
from snarfcli.registration.starts import PoseFinder
from snarfcli.registration.tracker import FittedSequence, fit_sequence

Array = NDArray[np.float64]

_VERTICES = 1200
_POINTS = 4000
_FRAME_RATE = 30.0
_TRAINING = 3  # training motions of each subject
_CLOTHES_M = 0.03
_NOISE_M, _NORMAL_NOISE = 0.005, 0.2
_FLOOR_POINTS, _FLOOR_M = 1000, 1.0
_UNSEEN = 0.3  # share of the points, those that face most to one side
_SINGLE_STEP = 20  # frames of a sequence, whose 6 or 12 frames are then fitted one by one in 2.5 s each
_OTHER_SHAPES = ("50102", "50104")
_ROWS = ("naked", "single", "clothed", "noise", "missing", "floor", "shapes", "real", "topology")
_LOST_SHARE, _LOST_MM = 0.2, 50.0


@dataclass(frozen=True)
class Sequence:
    """The true states of a body, and the meshes that are scanned."""

    body: Body
    betas: Array
    poses: Array
    translation: Array
    mesh: Callable[[int], tuple[NDArray, NDArray]]

    def joints(self) -> Array:
        """Return the joints [T, J, 3], metres."""
        return self.body.pose(self.poses, self.betas, self.translation).joints.numpy()


class Scanned:
    """Points of the meshes of a sequence; measures the time that making them takes.

    Args:
        sequence: what is scanned.
        row: of the table, which says how the scans are damaged.
    """

    def __init__(self, sequence: Sequence, row: str) -> None:
        self.sequence, self.row, self.seconds = sequence, row, 0.0

    def __len__(self) -> int:
        return len(self.sequence.poses)

    def __getitem__(self, index: int) -> ScanPoints:
        started = time.process_time()
        mesh = trimesh.Trimesh(*self.sequence.mesh(index), process=False)
        points, faces = trimesh.sample.sample_surface(mesh, _POINTS, seed=index)[:2]
        scan = ScanPoints.sampled(*_damaged(np.asarray(points), mesh.face_normals[faces], self.row, index), 10 * _POINTS, index)
        self.seconds += time.process_time() - started
        return scan


def _damaged(points: Array, normals: Array, row: str, seed: int) -> tuple[Array, Array]:
    """Return points and normals with the fault of a row."""
    draws = np.random.default_rng(seed)
    if row == "noise":
        normals = normals + draws.normal(0, _NORMAL_NOISE, normals.shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return points + draws.normal(0, _NOISE_M, points.shape), normals
    if row == "missing":
        towards = normals @ (0.8, 0.0, 0.6)
        seen = towards < np.quantile(towards, 1 - _UNSEEN)
        return points[seen], normals[seen]
    if row == "floor":
        floor = draws.uniform(-_FLOOR_M, _FLOOR_M, (_FLOOR_POINTS, 3)) + (points.max(0) + points.min(0)) / 2
        floor[:, 1] = points[:, 1].min()
        up = np.tile([0.0, 1.0, 0.0], (_FLOOR_POINTS, 1))
        return np.concatenate([points, floor]), np.concatenate([normals, up])
    return points, normals


def _of_subject(subject: str, motion: str, row: str) -> Sequence:
    """Return a sequence of a built-in subject at 30 frames per second."""
    data = _subject(subject, row == "clothed")
    spec = next(spec for spec in data.sequences if spec.name == motion)
    step = round(spec.motion.frame_rate / _FRAME_RATE) * (_SINGLE_STEP if row == "single" else 1)
    frames = np.arange(0, spec.motion.num_frames, step)
    poses, translation = spec.motion.poses[frames], spec.motion.translation[frames]
    return Sequence(_body(None), np.asarray(data.betas), poses, translation, lambda index: spec.meshes[int(frames[index])])


def _of_body(body: Body, betas: Array, poses: Array, translation: Array) -> Sequence:
    """Return a sequence of a body without clothes."""

    def mesh(index: int) -> tuple[NDArray, NDArray]:
        return body.pose(poses[index][None], betas, translation[index][None]).vertices[0].numpy(), body.faces.numpy()

    return Sequence(body, betas, poses, translation, mesh)


@lru_cache
def _subject(subject: str, is_clothed: bool):
    return (clothed_subject if is_clothed else builtin_subject)(subject)


@lru_cache
def _body(path: Path | None) -> Body:
    return (builtin_body() if path is None else load_body(path)).to(torch.float64)


def _shape(name: str, count: int) -> Array:
    """Return shape parameters within 2.5 standard deviations."""
    return np.clip(1.3 * np.random.default_rng(int(name)).standard_normal(count), -2.5, 2.5)


def _jobs(options: argparse.Namespace) -> Iterator[tuple[str, str, str]]:
    """Yield the row, the subject and the motion of each sequence."""
    for row in options.rows:
        if row == "real":
            yield from ((row, "body", path.name) for path in sorted(Path(options.motion_folder or ".").glob("*.npz")))
            continue
        subjects = _OTHER_SHAPES if row == "shapes" else options.subjects
        for subject in subjects:
            names = [
                spec.name for spec in _subject(BUILTIN_SUBJECTS[0] if row == "shapes" else subject, False).of_split("train")
            ]
            motions = (*names[:_TRAINING], *OUT_OF_DISTRIBUTION_SEQUENCES)
            yield from ((row, subject, name) for name in motions if not options.motions or name in options.motions)


def _sequence(row: str, subject: str, motion: str, options: argparse.Namespace) -> Sequence:
    if row == "real":
        body = _body(options.body)
        clip = read_motion(Path(options.motion_folder) / motion)
        return _of_body(body, _shape("7", body.num_betas), clip.poses, clip.translation)
    if row == "shapes":
        body = _body(None)
        clip = builtin_motion(motion, int(subject), frame_rate=_FRAME_RATE)
        return _of_body(body, _shape(subject, body.num_betas), clip.poses, clip.translation)
    return _of_subject(subject, motion, row)


def _fitted(row: str, motion: str, sequence: Sequence, scans: Scanned) -> tuple[BodySurface, FittedSequence]:
    """Fit one sequence."""
    surface = BodySurface.from_body(sequence.body, len(sequence.body.v_template) if row == "topology" else _VERTICES)
    if row == "topology":
        faces = sequence.body.faces.numpy()
        return surface, fit_one_topology(surface, faces, faces, lambda index: sequence.mesh(index)[0], len(scans), {})
    finder, prior = _finder(sequence.body, motion)
    clothes_m = _CLOTHES_M if row == "clothed" else 0.0
    is_ordered = row != "single"
    return surface, fit_sequence(surface, scans, finder, prior, betas=None, clothes_m=clothes_m, is_ordered=is_ordered)


@lru_cache(maxsize=2)
def _finder(body: Body, motion: str) -> tuple[PoseFinder, PosePrior]:
    surface, prior = BodySurface.from_body(body, _VERTICES), PosePrior.weak(body.num_joints)
    return PoseFinder(surface, PoseLibrary.builtin(body.joint_names, (motion,)), prior), prior


def _measured(row: str, motion: str, sequence: Sequence) -> dict[str, object]:
    """Fit one sequence; return the mean joint error of each frame, millimetres, and the processor time."""
    if row != "topology":
        _finder(sequence.body, motion)  # made once per body and motion, not part of the time of a sequence
    scans = Scanned(sequence, row)
    started = time.process_time()
    surface, fitted = _fitted(row, motion, sequence, scans)
    seconds = time.process_time() - started - scans.seconds
    pairs = zip(fitted.poses, fitted.translation, strict=True)
    found = np.stack([surface.joints(BodyState.from_pose(*pair, fitted.betas)) for pair in pairs])
    error = 1000 * np.linalg.norm(found - sequence.joints(), axis=2).mean(1)
    return {"error_mm": error.round(2).tolist(), "seconds": round(seconds, 2), "trusted": fitted.is_trusted.tolist()}


def _row(name: str, lines: list[dict]) -> list[str]:
    """Return the row of a table."""
    error = np.concatenate([line["error_mm"] for line in lines])
    trusted = np.concatenate([line["trusted"] for line in lines])
    lost = sum(np.mean(np.array(line["error_mm"]) > _LOST_MM) > _LOST_SHARE for line in lines)
    under = [f"{100 * (error < limit).mean():.1f}" for limit in (15, 25)]
    seconds = sum(line["seconds"] for line in lines) / len(error)
    return [
        name, str(len(lines)), str(len(error)), f"{error.mean():.1f}", f"{np.quantile(error, 0.95):.1f}", *under, str(lost),
        f"{100 * trusted.mean():.1f}", f"{seconds:.2f}",
    ]  # fmt: skip


def main() -> None:
    """Fit what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="file with one JSON line per sequence")
    parser.add_argument("--run", action="store_true", help="fit the sequences that the file does not have")
    parser.add_argument("--rows", nargs="+", choices=_ROWS, default=["naked"])
    parser.add_argument("--single", action="store_true", help="the same as --rows single")
    parser.add_argument("--subjects", nargs="+", choices=BUILTIN_SUBJECTS, default=list(BUILTIN_SUBJECTS))
    parser.add_argument("--motions", nargs="+", default=[], help="only these")
    parser.add_argument("--motion-folder", help="AMASS files for row real")
    parser.add_argument("--body", type=Path, help="body for row real (default: the built-in one)")
    parser.add_argument("--part", default="1/1", help="i/n: every n-th sequence, beginning with the i-th")
    options = parser.parse_args()
    if options.single:
        options.rows = ["single"]
    if "real" in options.rows and not options.motion_folder:
        parser.error("row real: give --motion-folder")
    torch.set_num_threads(1)
    lines = [json.loads(line) for line in options.results.read_text().splitlines()] if options.results.exists() else []
    done = {tuple(line["job"]) for line in lines}
    part, parts = map(int, options.part.split("/"))
    for job in list(_jobs(options))[part - 1 :: parts] if options.run else ():
        if job in done:
            continue
        line = {"job": job, **_measured(job[0], job[2], _sequence(*job, options))}
        lines.append(line)
        with options.results.open("a") as file:
            file.write(json.dumps(line) + "\n")
        print(*job, " ".join(_row("", [line])[3:]), flush=True)
    print_machine()
    header = [
        "data",
        "sequences",
        "frames",
        "mean, mm",
        "95 %, mm",
        "< 15 mm, %",
        "< 25 mm, %",
        "lost",
        "trusted, %",
        "s per frame",
    ]
    rows = [[line for line in lines if line["job"][0] == row] for row in _ROWS]
    print_table(header, [_row(row, of_row) for row, of_row in zip(_ROWS, rows, strict=True) if of_row])


if __name__ == "__main__":
    main()
