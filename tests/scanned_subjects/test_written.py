"""The files of a fit, and how they are told from those of others."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_scans import BETAS, toy_poses, write_scans

from snarfcli.bodies import builtin_body
from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.files import write_arrays
from snarfcli.motions import read_motion
from snarfcli.scanned_subjects.written import (
    FitMade,
    FittedFile,
    foreign_files,
    own_poses,
    read_fitted,
    read_made,
    remove_replaced,
    write_fitted,
    write_skeleton,
)

SETTINGS = {"seed": 0, "body": None}


def fitted(frames: int = 2) -> FittedFile:
    poses, places = toy_poses(frames)
    trusted = np.arange(frames) > 0
    reasons = tuple("" if one else "far away" for one in trusted)
    return FittedFile(poses, places, np.full(frames, 0.004), trusted, reasons, poses[..., 0] > 0.5, "abc", 3.0)


@pytest.mark.parametrize(("scale", "up"), [(1.0, "y"), (0.001, "z")])
def test_the_files_are_those_of_a_subject(tmp_path: Path, scale: float, up: str) -> None:
    place = tmp_path / "meshes" / "me"
    poses, places = write_scans(place / "walk", 2, unit_m=scale, up=up)
    made = FitMade(BETAS, FileToWorld(scale, up), SETTINGS)
    skeleton = builtin_body().skeleton(BETAS)
    write_skeleton(place, skeleton, made)
    write_fitted(place / "walk", fitted(), made, 25.0)
    data = find_dataset("meshes").load("me", Request(DataConfig("meshes", 1, 1, 1), tmp_path))
    assert not data.broken
    np.testing.assert_allclose(data.skeleton.joints_rest.numpy(), skeleton.joints_rest.numpy(), atol=1e-6)
    np.testing.assert_allclose(data.skeleton.canonical_pose.numpy(), skeleton.canonical_pose.numpy(), atol=1e-6)
    spec = data.sequences[0]
    assert spec.motion.frame_rate == 25.0
    frame = spec.motion.num_frames - 1
    np.testing.assert_allclose(spec.motion.poses[frame], poses[frame], atol=1e-9)
    np.testing.assert_allclose(spec.motion.translation[frame], places[frame], atol=1e-9)
    motion = read_motion(place / "walk" / "poses.npz", data.skeleton)  # as for --pose
    assert (motion.name, motion.frame_rate) == ("walk", 25.0)
    np.testing.assert_allclose(motion.poses, fitted().poses, atol=1e-9)
    np.testing.assert_allclose(motion.translation, fitted().translation, atol=1e-9)
    vertices, _ = spec.meshes[frame]
    body = builtin_body().pose(torch.from_numpy(poses[[frame]]).float(), BETAS, torch.from_numpy(places[[frame]]).float())
    np.testing.assert_allclose(vertices, body.vertices[0].numpy(), atol=1e-4)


def test_a_fit_reads_its_own_files_only(tmp_path: Path) -> None:
    made = FitMade(BETAS, FileToWorld(0.01, "z"), SETTINGS)
    assert read_made(tmp_path) is None
    assert read_fitted(tmp_path, made, 24) is None
    write_skeleton(tmp_path, builtin_body().skeleton(BETAS), made)
    write_fitted(tmp_path, fitted(), made, 30.0)
    again = read_made(tmp_path)
    assert again is not None
    assert again.digest == made.digest
    there = read_fitted(tmp_path, made, 24)
    assert there is not None
    np.testing.assert_allclose(there.poses, fitted().poses, atol=1e-12)
    np.testing.assert_allclose(there.translation, fitted().translation, atol=1e-12)
    assert there.reasons == ("far away", "")
    assert read_fitted(tmp_path, made, 23) is None
    assert not foreign_files(tmp_path, [tmp_path])
    assert own_poses([tmp_path, tmp_path / "elsewhere"]) == [tmp_path / "poses.npz"]
    assert read_fitted(tmp_path, FitMade(BETAS + 0.1, made.world, SETTINGS), 24) is None
    assert read_fitted(tmp_path, FitMade(BETAS, made.world, {**SETTINGS, "seed": 1}), 24) is None
    for name in ("skeleton.npz", "poses.npz"):
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-200])
    assert read_made(tmp_path) is None
    assert read_fitted(tmp_path, made, 24) is None


@pytest.mark.parametrize("betas", [np.nan, 1e300])
def test_a_skeleton_with_numbers_of_a_damaged_file_is_none(tmp_path: Path, betas: float) -> None:
    skeleton = builtin_body().skeleton(BETAS)
    write_skeleton(tmp_path, skeleton, FitMade(np.full(10, betas), FileToWorld(1.0, "y"), SETTINGS))
    assert read_made(tmp_path) is None


def test_files_of_others_are_found_and_replaced(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    (tmp_path / "skeleton.json").write_text(json.dumps({"parents": [-1], "joints_rest": [[0, 0, 0]]}))
    write_arrays(tmp_path / "walk" / "poses.npz", {"poses": np.zeros((1, 1, 3))})
    (tmp_path / "walk" / "motion.bvh").write_text("HIERARCHY")
    found = foreign_files(tmp_path, [tmp_path / "walk"])
    assert [path.name for path in found] == ["skeleton.json", "poses.npz", "motion.bvh"]
    assert not own_poses([tmp_path / "walk"])
    remove_replaced(tmp_path, [])
    assert [path.name for path in foreign_files(tmp_path, [tmp_path / "walk"])] == ["poses.npz", "motion.bvh"]
    remove_replaced(tmp_path, [tmp_path / "walk"])
    assert not foreign_files(tmp_path, [tmp_path / "walk"])
