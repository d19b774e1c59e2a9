"""Write a person in clothes as a scanner would: points without faces, normals, poses or a skeleton, for `snarf fit`.

The scans are those of a built-in subject in clothes (CC0), so that the whole way from points to a character can be tried
without data. Run it with `python examples/scans.py data/meshes/me`; then:

    snarf fit data=meshes subject=me clothes=true
    snarf preprocess data=meshes subject=me
    snarf train data=meshes subject=me training=quick training.refine_poses=true
    snarf export data=meshes subject=me

The packages of the extra `commands` are needed (`pip install '.[commands]'`).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

DATA, SUBJECT = "clothed", "50002"
SEQUENCES = ("jumping_jacks", "knees", "punching", "shake_hips")  # the last one by name is held out
FRAME_RATE = 30


def write_ply(path: Path, points: np.ndarray) -> None:
    """Write points [P, 3] as a binary PLY file that has nothing else."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    path.write_bytes(f"{header.format(len(points))}end_header\n".encode() + points.astype("<f4").tobytes())


def write_scans(
    folder: Path, sequences: Sequence[str] = SEQUENCES, frames: int = 60, points: int = 5000, data: str = DATA
) -> None:
    """Write a folder of scans per sequence, in metres with y up.

    Args:
        folder: folder of the subject.
        sequences: built-in motions.
        frames: number of frames of each, at 30 per second.
        points: number of points of each frame, in random places on the surface.
        data: data set of the subject.
    """
    from snarfcli.datasets.registry import find_dataset
    from snarfcli.datasets.settings import DataConfig
    from snarfcli.datasets.sources import Request
    from snarfcli.sampling import uniform_surface_samples

    subject = find_dataset(data).load(SUBJECT, Request(DataConfig(data, 1, 1, 1), Path("data")))
    for sequence in subject.sequences:
        if sequence.name not in sequences:
            continue
        place = folder / sequence.name
        place.mkdir(parents=True, exist_ok=True)
        step = round(sequence.motion.frame_rate / FRAME_RATE)
        chosen = np.arange(0, sequence.motion.num_frames, step)[:frames]
        meshes = sequence.meshes.chosen(chosen)
        for number, frame in enumerate(chosen):
            generator = np.random.default_rng([number, len(sequence.name)])
            write_ply(place / f"{frame:04}.ply", uniform_surface_samples(*meshes[number], points, generator))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write a person in clothes as points without faces.")
    parser.add_argument("folder", type=Path, help="folder of the subject, such as data/meshes/me")
    parser.add_argument("--frames", type=int, default=60, help="number of frames of each motion")
    arguments = parser.parse_args()
    write_scans(arguments.folder, frames=arguments.frames)
