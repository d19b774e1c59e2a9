"""How far the surface near a bone moves between frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from toy_animal import animal_motion, make_animal

from snarfcli.bodies import Skeleton, axis_angle_to_matrix
from snarfcli.datasets.pose_consistency import measure_pose_consistency

ANIMAL = make_animal(0.08)
SKELETON = Skeleton(ANIMAL.names, ANIMAL.parents, torch.from_numpy(ANIMAL.joints), torch.zeros(len(ANIMAL.names), 3))


@dataclass(frozen=True)
class Posed:
    vertices: np.ndarray
    faces: np.ndarray
    posed_from_rest: np.ndarray

    @property
    def joints(self) -> np.ndarray:
        return np.einsum("jrc,jc->jr", self.posed_from_rest[:, :3, :3], ANIMAL.joints) + self.posed_from_rest[:, :3, 3]


@pytest.fixture(scope="module")
def frames() -> list[Posed]:
    motion = animal_motion("walk", 8)
    moved = SKELETON.posed_from_rest(torch.from_numpy(motion.poses), torch.from_numpy(motion.translation)).numpy()
    return [Posed(*mesh, bones) for *mesh, bones in zip(ANIMAL.posed(motion), [ANIMAL.faces] * 8, moved, strict=True)]


def shifted(frames: list[Posed], shifts: np.ndarray) -> list[Posed]:
    """Return the frames with bones that are elsewhere, [T, 3] metres."""
    moves = np.tile(np.eye(4), (len(frames), 1, 1))
    moves[:, :3, 3] = shifts
    return [replace(frame, posed_from_rest=move @ frame.posed_from_rest) for frame, move in zip(frames, moves, strict=True)]


def test_correct_poses(frames):
    fit = measure_pose_consistency(SKELETON, frames)
    assert fit is not None
    assert fit.moved_m < 1e-3  # measured 5e-4: the skin bends near the joints
    assert (fit.bones, fit.frames) == (18, 8)
    assert fit.length_m == pytest.approx(1.14, abs=0.1)
    assert measure_pose_consistency(SKELETON, frames) == fit


def test_a_place_that_is_wrong_in_every_frame_is_measured(frames):
    random = np.random.default_rng(0)
    fit = measure_pose_consistency(SKELETON, shifted(frames, random.normal(0, 0.02 / np.sqrt(3), (8, 3))))
    assert fit is not None
    # A difference of two shifts of 2 cm is 2.8 cm long; the part along the normals of a tube is about half of it.
    assert 0.006 < fit.moved_m < 0.025


def test_the_same_error_in_every_frame_does_no_harm(frames):
    """The bones are 1 cm beside their place in the axes of each bone: an avatar can be learned with them."""
    offset = np.eye(4)
    offset[:3, 3] = 0.01 / np.sqrt(3)
    fit = measure_pose_consistency(
        SKELETON, [replace(frame, posed_from_rest=frame.posed_from_rest @ offset) for frame in frames]
    )
    assert fit is not None
    assert fit.moved_m < 2e-3


def test_topologies_may_differ(frames):
    random = np.random.default_rng(0)
    mixed = []
    for frame in frames:
        order = random.permutation(len(frame.vertices))
        place = np.argsort(order)
        cut = len(frame.faces) - int(random.integers(1, 6))  # open, too
        mixed.append(Posed(frame.vertices[order], random.permutation(place[frame.faces])[:cut], frame.posed_from_rest))
    fit = measure_pose_consistency(SKELETON, mixed)
    assert fit is not None
    assert fit.moved_m < 1e-3


def test_nothing_to_measure(frames):
    assert measure_pose_consistency(SKELETON, frames[:1]) is None
    alone = Skeleton(("root",), (-1,), SKELETON.joints_rest[:1], torch.zeros(1, 3))
    assert measure_pose_consistency(alone, frames) is None
    flat = [replace(frame, vertices=np.zeros_like(frame.vertices)) for frame in frames]
    assert measure_pose_consistency(SKELETON, flat) is None
    singular = [replace(frame, posed_from_rest=0 * frame.posed_from_rest) for frame in frames]
    assert measure_pose_consistency(SKELETON, singular) is None
    broken = [replace(frame, posed_from_rest=np.nan * frame.posed_from_rest) for frame in frames[1:]]
    assert measure_pose_consistency(SKELETON, [frames[0], *broken]) is None


def test_a_turn_at_one_joint_is_of_its_bones_only(frames):
    """A wrong tail does not count: medians over bones ignore a part that does not follow its bone."""
    turn = axis_angle_to_matrix(torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)).numpy()
    tail = ANIMAL.names.index("tail1")
    wrong = []
    for number, frame in enumerate(frames):
        moved = frame.posed_from_rest.copy()
        if number % 2:
            moved[tail, :3, :3] = turn @ moved[tail, :3, :3]
        wrong.append(replace(frame, posed_from_rest=moved))
    fit = measure_pose_consistency(SKELETON, wrong)
    assert fit is not None
    assert fit.moved_m < 1e-3
