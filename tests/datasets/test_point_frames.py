"""Subjects whose frames are points, and frames whose poses are not trusted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toy_animal import Animal, animal_motion, make_animal
from toy_animal_files import write_animal_meshes

from snarfcli.datasets import meshes
from snarfcli.datasets.checking import check_subject
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings, oriented_surface_samples, winding_numbers

FRAMES = 6
STEPS = {"train": 1, "test": 1, "ood": 1}
SAMPLING = SamplingSettings(points_per_frame=400, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)


def request(folder: Path, **settings) -> Request:
    return Request(DataConfig("meshes", 1, 1, 1, folder=str(folder), **settings), Path("nowhere"))


@pytest.fixture(scope="module")
def animal() -> Animal:
    return make_animal(0.08)


def write_poses(folder: Path, animal: Animal, name: str, trusted=None) -> None:
    motion = animal_motion(name, FRAMES)
    flags = {} if trusted is None else {"trusted": np.array(trusted)}
    np.savez(folder / "rex" / name / "poses.npz", poses=motion.poses, trans=motion.translation, frame_rate=30, **flags)


def write_points(folder: Path, animal: Animal, name: str, *, with_normals: bool) -> None:
    """Replace the meshes of a sequence by points on what is seen of them."""
    motion = animal_motion(name, FRAMES)
    for path in (folder / "rex" / name).glob("*.obj"):
        path.unlink()
    for frame, vertices in enumerate(animal.posed(motion)):
        points, normals = oriented_surface_samples(vertices, animal.faces, 5000, np.random.default_rng(frame))
        is_seen = winding_numbers(vertices, animal.faces, points + 1e-3 * normals) < 0.5  # not where parts overlap
        points, normals = points[is_seen], normals[is_seen]
        place = folder / "rex" / name / f"{frame:04}"
        if with_normals:
            np.savez(place.with_suffix(".npz"), points=points, normals=-normals)  # inward
        else:
            np.savetxt(place.with_suffix(".xyz"), points, "%.5f")


def test_closed_surfaces_of_points_give_the_labels_of_the_meshes(animal, tmp_path):
    write_animal_meshes(tmp_path / "rex", animal, [animal_motion(name, FRAMES) for name in ("sit", "walk")])
    write_points(tmp_path, animal, "sit", with_normals=False)
    write_points(tmp_path, animal, "walk", with_normals=True)
    subject = meshes.load("rex", request(tmp_path, scale="1"))
    assert any("closed surface is put around" in line for line in subject.sources)
    preprocess_subject(subject, tmp_path / "data", SAMPLING, {"train": 3, "test": 3, "ood": 3})
    store = SampleStore.open(tmp_path / "data", "meshes", "rex")
    for sequence in (*store.sequences("train"), *store.sequences("test")):
        assert sequence.description["boundary_edges"] == 0
        posed = animal.posed(animal_motion(sequence.name, FRAMES))
        for row, frame in enumerate(sequence.frame_numbers):
            inside = winding_numbers(posed[frame], animal.faces, sequence.points(row)) > 0.5
            assert (sequence.occupancies(row) == inside).mean() > 0.93  # half of the points are about 1 cm from the surface


def test_a_frame_that_encloses_nothing_is_named(animal, tmp_path):
    write_animal_meshes(tmp_path / "rex", animal, [animal_motion("sit", FRAMES)])
    write_points(tmp_path, animal, "sit", with_normals=False)
    (tmp_path / "rex" / "sit" / "0003.xyz").write_text("0 0 0\n1 1 1\n")
    subject = meshes.load("rex", request(tmp_path))
    with pytest.raises(UserError, match=r"no surface can be closed around the points of .*0003.xyz .*at least 16 points"):
        preprocess_subject(subject, tmp_path / "data", SAMPLING, STEPS)


def test_frames_that_are_not_trusted_are_left_out_and_counted(animal, tmp_path):
    write_animal_meshes(tmp_path / "rex", animal, [animal_motion(name, FRAMES) for name in ("sit", "trot", "walk")])
    write_poses(tmp_path, animal, "sit", [True, False, False, True, True, True])
    write_poses(tmp_path, animal, "walk", [False, True, True, True, True, False])
    subject = meshes.load("rex", request(tmp_path))
    line = next(line for line in subject.sources if "not trusted" in line)
    assert line.startswith("4 frames left out, whose poses are not trusted (sit 2 of 6, walk 2 of 6)")
    preprocess_subject(subject, tmp_path / "data", SAMPLING, STEPS)
    store = SampleStore.open(tmp_path / "data", "meshes", "rex")
    numbers = {each.name: each.frame_numbers.tolist() for split in ("train", "test") for each in store.sequences(split)}
    assert numbers == {"sit": [0, 3, 4, 5], "trot": [0, 1, 2, 3, 4, 5], "walk": [1, 2, 3, 4]}  # numbers of the files
    by_name = {spec.name: spec for spec in subject.sequences}
    assert by_name["sit"].every(2).tolist() == [0, 3, 4]  # the first trusted one of every two
    assert by_name["sit"].motion.num_frames == FRAMES
    assert any("not trusted" in remark.text for remark in check_subject("rex", request(tmp_path)))
    every = meshes.load("rex", request(tmp_path, untrusted=True))
    assert not any("not trusted" in line for line in every.sources)
    assert every.sequences[0].every(1).tolist() == list(range(FRAMES))


def test_a_sequence_without_trusted_frames_cannot_be_used(animal, tmp_path):
    write_animal_meshes(tmp_path / "rex", animal, [animal_motion(name, FRAMES) for name in ("sit", "walk")])
    write_poses(tmp_path, animal, "sit", [False] * FRAMES)
    assert "none of its 6 frames is trusted; data.untrusted=true" in dict(meshes.load("rex", request(tmp_path)).broken)["sit"]
    assert not meshes.load("rex", request(tmp_path, untrusted=True)).broken
    write_poses(tmp_path, animal, "sit", [True] * (FRAMES - 1))
    reason = dict(meshes.load("rex", request(tmp_path)).broken)["sit"]
    assert "trusted: wanted 6 values true or false" in reason


def test_the_end_of_an_only_sequence_has_trusted_frames(animal, tmp_path):
    write_animal_meshes(tmp_path / "rex", animal, [animal_motion("walk", FRAMES)])
    write_poses(tmp_path, animal, "walk", [True, False, True, True, False, False])
    train, test = meshes.load("rex", request(tmp_path)).sequences
    assert (train.every(1).tolist(), train.motion.num_frames) == ([0, 2], 3)
    assert (test.every(1).tolist(), test.motion.num_frames) == ([0], 3)
