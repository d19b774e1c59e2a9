"""The built-in subjects: ten different shapes, the held-out sequences of the papers, reproducible results."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from licensed_files import write_body

from snarfcli.bodies import builtin_body
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, HELD_OUT_SEQUENCES, builtin_subject, load
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES

BODY = builtin_body()


@pytest.fixture(scope="module")
def subjects():
    return {subject: builtin_subject(subject) for subject in BUILTIN_SUBJECTS}


def test_ids_are_dfausts():
    assert len(BUILTIN_SUBJECTS) == 10
    assert BUILTIN_SUBJECTS[0] == "50002"
    assert BUILTIN_SUBJECTS[-1] == "50027"


@pytest.mark.parametrize("subject", BUILTIN_SUBJECTS)
def test_one_sequence_is_held_out(subjects, subject):
    data = subjects[subject]
    assert data.data == "builtin"
    assert data.subject == subject
    train, test, ood = ([sequence.name for sequence in data.of_split(split)] for split in ("train", "test", "ood"))
    assert len(train) == 9
    assert len(set(train)) == 9
    assert test == [HELD_OUT_SEQUENCES[subject]]
    assert test[0] not in train
    assert set(train + test) <= set(TRAINING_SEQUENCES)
    assert ood == list(OUT_OF_DISTRIBUTION_SEQUENCES)
    assert len(ood) == 7
    assert all(sequence.motion.frame_rate == 60.0 for sequence in data.sequences)


def test_every_exercise_is_someones(subjects):
    assert {sequence.name for data in subjects.values() for sequence in data.of_split("train")} == set(TRAINING_SEQUENCES)


def test_shapes_are_plausible_and_distinct(subjects):
    for data in subjects.values():
        assert np.abs(data.betas).max() <= 2
        assert data.betas.shape == (10,)
        height = np.ptp(BODY.shaped(data.betas)[0][:, 1].numpy())
        assert 1.45 < height < 1.95
    for one, other in combinations(subjects.values(), 2):
        assert np.linalg.norm(one.betas - other.betas) > 1.0
        apart = (BODY.shaped(one.betas)[0] - BODY.shaped(other.betas)[0]).norm(dim=1)
        assert apart.mean() > 0.005  # metres


def test_same_subject_again(subjects):
    again = builtin_subject(50002)
    first = subjects["50002"]
    assert np.array_equal(again.betas, first.betas)
    assert torch.equal(again.skeleton.joints_rest, first.skeleton.joints_rest)
    for one, other in zip(first.sequences, again.sequences, strict=True):
        assert (one.name, one.split) == (other.name, other.split)
        assert np.array_equal(one.motion.poses, other.motion.poses)


def test_skeleton_is_the_shaped_bodys(subjects):
    data = subjects["50025"]
    torch.testing.assert_close(data.skeleton.joints_rest, BODY.shaped(data.betas)[1])


def test_feet_reach_everyones_own_floor(subjects):
    for subject in ("50002", "50007", "50025"):
        data = subjects[subject]
        floor = BODY.shaped(data.betas)[0][:, 1].min()
        for sequence in data.sequences:
            motion = sequence.motion.slice(step=sequence.motion.num_frames // 4)
            lowest = BODY.pose(motion.poses, data.betas, motion.translation).vertices[..., 1].amin(1) - floor
            assert lowest.min() > -0.05, sequence.name
            assert lowest.max() < 0.15, sequence.name  # hops reach about 0.1 m


def test_unknown_subject():
    with pytest.raises(UserError, match=r"no built-in subject '50003'; did you mean '500\d\d'\? Wanted one of 50002, 50004"):
        builtin_subject("50003")
    with pytest.raises(UserError, match=r"no built-in subject 'me'. Wanted one of"):
        builtin_subject("me")


def test_a_body_of_ones_own(tmp_path):
    """The built-in motions on an SMPL body: found under the name it is downloaded with, and named."""
    path = write_body(tmp_path / "smpl" / "models").rename(tmp_path / "smpl" / "models" / "SMPL_NEUTRAL.npz")
    request = Request(DataConfig("builtin", 1, 1, 1), tmp_path, body=str(tmp_path / "smpl"))
    own, first = load("50004", request), builtin_subject("50004")
    assert own.sources[0] == f"body {path}"
    assert own.data == "builtin"
    np.testing.assert_allclose(own.template.vertices, first.template.vertices, atol=1e-6)
    with pytest.raises(UserError, match="neutral"):
        load("50004", Request(request.config, tmp_path, body=str(write_body(tmp_path / "other").parent)))
