"""The example with scans: it writes points and nothing else, which become samples once there are poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scans

from snarfcli.datasets import meshes
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.point_clouds import PointFile, read_frame
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings


def write_true_poses(folder: Path, frames: int) -> None:
    """Write skeleton and poses as `snarf fit` would find them if it made no error."""
    subject = find_dataset("builtin").load(scans.SUBJECT, Request(DataConfig("builtin", 1, 1, 1), Path("data")))
    skeleton = subject.skeleton
    np.savez(
        folder / "skeleton.npz",
        names=np.array(skeleton.names),
        parents=np.array(skeleton.parents),
        joints_rest=skeleton.joints_rest.numpy(),
    )
    for sequence in subject.sequences:
        if (folder / sequence.name).is_dir():
            chosen = slice(0, 2 * frames, 2)
            motion = sequence.motion
            np.savez(folder / sequence.name / "poses.npz", poses=motion.poses[chosen], trans=motion.translation[chosen])


def test_the_scans_are_points_and_become_samples(tmp_path):
    scans.write_scans(tmp_path / "me", ("knees", "punching"), frames=2, points=4000, data="builtin")  # clothes take 20 s
    paths = sorted((tmp_path / "me").rglob("*.*"))
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == [
        "me/knees/0000.ply", "me/knees/0002.ply", "me/punching/0000.ply", "me/punching/0002.ply",
    ]  # fmt: skip
    frame = read_frame(paths[0])
    assert isinstance(frame, PointFile)
    assert frame.points.shape == (4000, 3)
    assert frame.normals is None
    write_true_poses(tmp_path / "me", frames=2)
    subject = meshes.load("me", Request(DataConfig("meshes", 1, 1, 1, folder=str(tmp_path)), tmp_path))
    sampling = SamplingSettings(points_per_frame=400, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
    preprocess_subject(subject, tmp_path / "data", sampling, {"train": 1, "test": 1, "ood": 1})
    for split in ("train", "test"):
        (sequence,) = SampleStore.open(tmp_path / "data", "meshes", "me").sequences(split)
        assert sequence.description["boundary_edges"] == 0
        assert 0.4 < np.mean([sequence.occupancies(row)[200:].mean() for row in range(2)]) < 0.6  # near the surface
