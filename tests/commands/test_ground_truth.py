"""Ground-truth meshes of a motion: built-in bodies in any pose, and sequences of samples."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from toy_training import toy_store

from snarfcli.bodies import Skeleton
from snarfcli.commands.ground_truth import ground_truth_meshes
from snarfcli.commands.selection import AvatarSelection, MotionSelection, SelectedMotion, select_motion
from snarfcli.datasets.builtin import builtin_subject
from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError
from snarfcli.samples.store import SampleStore

CHOICE = AvatarSelection("50004", DataConfig("builtin", 8, 1, 1), "data", "outputs", "fast_snarf", None, "cpu", None)
PLAIN = MotionSelection("auto", "rest", "auto", None, None, 0, 30.0, 0, None, 1, None, None, False)


def avatar_of(skeleton: Skeleton, **facts: str) -> SimpleNamespace:
    return SimpleNamespace(skeleton=skeleton, facts=facts)


@pytest.fixture(scope="module")
def subject():
    return builtin_subject("50004")


def part(motion, numbers) -> SelectedMotion:
    taken = replace(motion, poses=motion.poses[numbers], translation=motion.translation[numbers])
    return SelectedMotion(taken, motion, numbers[0], numbers)


def test_a_built_in_body_is_known_in_every_pose(subject):
    sequence = subject.sequences[0]
    chosen = part(sequence.motion, [3, 8])
    truth = ground_truth_meshes(CHOICE, PLAIN, avatar_of(subject.skeleton, data="builtin", subject="50004"), chosen, "any.npz")
    for index, frame in enumerate(chosen.numbers):
        for came, wanted in zip(truth[index], sequence.meshes[frame], strict=True):
            np.testing.assert_array_equal(came, wanted)


def test_another_body_or_data_set_has_none(subject):
    chosen = part(subject.sequences[0].motion, [0])
    taller = replace(subject.skeleton, joints_rest=subject.skeleton.joints_rest * 1.1)
    with pytest.raises(UserError, match="the skeleton of avatar 50004 is not that of the built-in body"):
        ground_truth_meshes(CHOICE, PLAIN, avatar_of(taller, data="builtin", subject="50004"), chosen, None)
    other = replace(CHOICE, data=DataConfig("dfaust", 8, 1, 1))
    for pose, what in ((None, "built-in motions"), ("a.npz", "pose files")):
        with pytest.raises(UserError, match=f"{what} have no ground truth with data=dfaust: .* leave truth out"):
            ground_truth_meshes(other, PLAIN, avatar_of(subject.skeleton, data="dfaust", subject="50004"), chosen, pose)


def test_samples_bring_their_own(tmp_path):
    toy_store(tmp_path, points=80, frames=6)
    (tmp_path / "processed" / "builtin").rename(tmp_path / "processed" / "meshes")
    store = SampleStore.open(tmp_path, "meshes", "toy")
    choice = replace(CHOICE, subject="toy", data=DataConfig("meshes", 1, 1, 1), data_root=str(tmp_path))
    avatar = avatar_of(store.skeleton, data="meshes", subject="toy")
    sequence = store.sequences("train")[0]
    plain = replace(PLAIN, step=2, in_place=True)
    chosen = select_motion(plain, choice, store.skeleton, None, sequence.name)
    truth = pickle.loads(pickle.dumps(ground_truth_meshes(choice, plain, avatar, chosen, None)))
    assert len(truth) == len(chosen.numbers) == 3
    way = sequence.translation[chosen.numbers] * (1, 0, 1)
    for index, frame in enumerate(chosen.numbers):
        vertices, faces = truth[index]
        np.testing.assert_allclose(vertices + way[index], sequence.vertices(frame), atol=1e-6)
        np.testing.assert_array_equal(faces, sequence.faces(frame))
    with pytest.raises(UserError, match="no meshes between their frames; leave out frame_rate, or truth"):
        ground_truth_meshes(choice, replace(plain, frame_rate=10.0), avatar, chosen, None)
