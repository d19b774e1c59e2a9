"""Following a body through sequences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scanned_person import BETAS, PRIOR, NearFinder, Person, surface
from scipy.spatial import KDTree

from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.matches import agreement
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.tracker import FittedSequence, fit_sequence
from snarfcli.registration.trust import unseen_joints


@pytest.fixture(scope="module")
def person() -> Person:
    return Person("punching", 12, count=1200)


def states_of(fitted: FittedSequence) -> list[BodyState]:
    pairs = zip(fitted.poses, fitted.translation, strict=True)
    return [BodyState.from_pose(pose, translation, fitted.betas) for pose, translation in pairs]


def near(state: BodyState) -> BodyState:
    draws = np.random.default_rng(0)
    return BodyState.from_pose(state.pose + draws.normal(0, 0.05, state.pose.shape), state.translation + 0.03, np.zeros(10))


def wrong(state: BodyState) -> BodyState:
    """Return a state with both arms up."""
    pose = state.pose
    pose[[16, 17]] = [[0, 0, 1.4], [0, 0, -1.4]]
    return BodyState.from_pose(pose, state.translation, state.betas)


def test_pose_and_shape_are_found_through_a_sequence(person):
    seen: list[int] = []
    finder = NearFinder([near(person.states[6])], surface())
    fitted = fit_sequence(surface(), person, finder, PRIOR, betas=None, on_frame=seen.append)
    assert person.errors_m(states_of(fitted)).max() < 0.01  # measured 0.006
    assert fitted.is_trusted.all()
    assert fitted.poses.shape == (12, 24, 3)
    assert fitted.reasons == ("",) * 12
    assert seen == list(range(12))
    assert fitted.residual_m.max() < 0.005  # measured 0.004, with vertices 6 cm apart


def test_a_wrong_start_does_not_spoil_the_sequence(person):
    # the first seed is right, the others are not
    finder = NearFinder([near(person.states[2]), wrong(person.states[6]), wrong(person.states[10])], surface())
    fitted = fit_sequence(surface(), person, finder, PRIOR, betas=BETAS)
    assert person.errors_m(states_of(fitted)).max() < 0.01
    np.testing.assert_array_equal(fitted.betas, BETAS)


def test_frames_without_the_person_are_not_trusted(person):
    class Broken:
        def __len__(self) -> int:
            return 12

        def __getitem__(self, index: int) -> ScanPoints:
            scan = person[index]
            return replace(scan, points=scan.points * np.array([1.0, 0.3, 1.0])) if index in (4, 5) else scan

    finder = NearFinder([near(person.states[2])], surface())
    fitted = fit_sequence(surface(), Broken(), finder, PRIOR, betas=BETAS)
    assert np.flatnonzero(~fitted.is_trusted).tolist() == [4, 5]
    assert "mm from the points" in fitted.reasons[4]
    kept = [index for index in range(12) if index not in (4, 5)]
    assert person.errors_m(states_of(fitted))[kept].max() < 0.01
    assert finder.calls > 3  # the bad frames were searched for, too


def test_frames_without_order_are_found_one_by_one(person):
    starts = [near(state) for state in person.states]
    starts[5] = wrong(person.states[5])  # its scan is like those of its neighbours
    finder = NearFinder(starts, surface())
    fitted = fit_sequence(surface(), person, finder, PRIOR, betas=BETAS, is_ordered=False)
    assert finder.calls == 12
    assert person.errors_m(states_of(fitted)).max() < 0.01
    assert fitted.is_trusted.all()


def arm_points(scan: ScanPoints, state: BodyState) -> np.ndarray:
    """Return which points of a scan are on the left forearm and hand."""
    body = surface(1200)
    nearest = KDTree(body.posed(state).points).query(scan.points)[1]
    return np.isin(body.bones[nearest], [18, 20, 22])


def test_limbs_that_are_cut_off_are_known_as_not_seen():
    person = Person("lunges", 12, count=4000)

    class Cut:
        def __len__(self) -> int:
            return 2

        def __getitem__(self, index: int) -> ScanPoints:
            scan = person[index]
            is_kept = ~arm_points(scan, person.states[index])
            return ScanPoints(scan.points[is_kept], scan.normals[is_kept])

    body = surface(1200)
    fitted = fit_sequence(body, Cut(), NearFinder([near(person.states[1])], body), PRIOR, betas=BETAS)
    names = {body.joint_names[joint] for joint in np.flatnonzero(fitted.unseen.all(0))}
    assert {"l_elbow", "l_hand"} <= names <= {"l_elbow", "l_wrist", "l_hand"}
    whole = agreement(body, person.states[0], person[0])
    assert not unseen_joints(whole.partners, body).any()


def test_estimated_normals_of_a_limb_may_point_inward(person):
    class InsideOut:
        def __init__(self, is_estimated: bool) -> None:
            self.is_estimated = is_estimated

        def __len__(self) -> int:
            return 3

        def __getitem__(self, index: int) -> ScanPoints:
            scan = person[index]
            side = np.where(arm_points(scan, person.states[index]), -1.0, 1.0)
            return ScanPoints(scan.points, side[:, None] * scan.normals, is_estimated=self.is_estimated)

    def errors_m(is_estimated: bool) -> np.ndarray:
        scans, finder = InsideOut(is_estimated), NearFinder([person.states[1]], surface())
        found = states_of(fit_sequence(surface(), scans, finder, PRIOR, betas=BETAS))
        joints = [[surface().joints(state)[[18, 20, 22]] for state in states] for states in (found, person.states[:3])]
        return np.linalg.norm(np.array(joints[0]) - joints[1], axis=2)

    assert errors_m(True).mean() < 0.03
    assert errors_m(True).mean() < 0.6 * errors_m(False).mean()
    given = InsideOut(False)[0]
    assert given.sided_by(surface().joints(person.states[0]), surface().parents) is given


def test_a_body_without_shape_parameters_is_followed(person):
    rigid = replace(
        surface(),
        joints_rest=surface().rest_joints(BETAS),
        joints_by_beta=np.zeros((24, 3, 0)),
        points_rest=surface().points_rest + surface().points_by_beta @ BETAS,
        points_by_beta=np.zeros((400, 3, 0)),
    )

    class Finder(NearFinder):
        def find(self, scan, *, betas=None, clothes_m=0.0, near=()):
            self.starts = [replace(start, betas=np.zeros(0)) for start in self.starts]
            return super().find(scan, betas=np.zeros(0), clothes_m=clothes_m)

    fitted = fit_sequence(rigid, person, Finder([person.states[6]], rigid), PRIOR, betas=None)
    assert fitted.betas.shape == (0,)
    found = [replace(state, betas=BETAS) for state in states_of(fitted)]
    assert person.errors_m(found).max() < 0.01


def test_no_frames_are_an_error():
    with pytest.raises(ValueError, match="at least one frame"):
        fit_sequence(surface(), [], NearFinder([], surface()), PRIOR, betas=BETAS)
