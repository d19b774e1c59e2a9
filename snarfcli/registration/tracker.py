"""Follow a body through a sequence of scans.

A few frames are fitted from nowhere. From the best of them the body is followed forwards and backwards; each frame starts where
its neighbour is, or where the motion goes on. Frames that agree with their scans less than usual are fitted again: from
both sides, limb by limb, and from nowhere. Every frame keeps the state with the smallest misfit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.fit_progress import FrameProgress
from snarfcli.registration.fitted_sequence import Finder, FittedSequence, Found, Scans
from snarfcli.registration.matches import Agreement, agreement, with_matches_by_place
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.shape import different_frames, fit_shape
from snarfcli.registration.solver import PosePrior, fit_state, scales
from snarfcli.registration.trust import apart_share, find_jumps, is_suspicious, judge, unseen_joints

__all__ = ["Finder", "FittedSequence", "Found", "Scans", "fit_sequence"]

Array = NDArray[np.float64]

_VERTICES = 600  # that follow the body; all vertices polish it
_KEPT_POINTS = 1_200_000  # of scans in memory: 300 scans of 4,000 points, 0.2 GB
_SEEDS = 3  # frames that are fitted from nowhere
_SHAPE_FRAMES = 12
_FOLLOW_M = scales(0.08, 0.03, 10)
_WIDE_M = scales(0.2, 0.03, 16)
_POLISH_M = scales(0.045, 0.025, 5)
_LOST = 1.3  # times the usual misfit: the step to this frame is tried again with longer scales
_BETTER = 0.98  # times the misfit of the state that is replaced
_SAME = 3  # frames without gain after which following a better state ends
_ALIKE = 3  # frames from which a suspicious one is fitted where frames have no order
_LOOKS = 200  # points of a scan from which its look is made
_ROUNDS = 3  # of fitting suspicious frames again
_FIND_WORK = 20  # processor time of a search from nowhere, in that of a frame to which the body is followed
_FINDS_PER_FRAME = 0.1  # searches from nowhere that a sequence may cost, per frame


def fit_sequence(
    surface: BodySurface,
    scans: Scans,
    finder: Finder,
    prior: PosePrior,
    *,
    betas: Array | None,
    clothes_m: float = 0.0,
    is_ordered: bool = True,
    on_frame: Callable[[int], None] | None = None,
) -> FittedSequence:
    """Fit a body to all frames of a sequence.

    Args:
        surface: the body.
        scans: the frames; points in random order.
        finder: of single frames.
        prior: of the pose.
        betas: [S], shape parameters; without them one shape is fitted to this sequence.
        clothes_m: depth that the body may have below the surface without cost, metres.
        is_ordered: each frame is close in time to its neighbours.
        on_frame: is called with the number of each frame, in order, as the work on the whole sequence goes on.

    Raises:
        ValueError: there are no frames.
    """
    if not len(scans):
        raise ValueError("scans: wanted at least one frame, got none")
    known = betas if surface.num_betas else np.zeros(0)
    work = _expected_work(len(scans), shape_is_known=known is not None, is_ordered=is_ordered)
    progress = FrameProgress(len(scans), work, len(scans), on_frame)
    tracker = _Tracker(surface, scans, finder, prior, clothes_m, progress)
    if not is_ordered:
        tracker.find_each(known)
        return tracker.polished(is_ordered=False)
    tracker.find_seeds(known, _SEEDS)
    tracker.follow_all()
    if known is None:
        tracker.fit_shape()
    for _ in range(_ROUNDS):
        if not tracker.repair():
            break
    return tracker.polished()


def _expected_work(frames: int, *, shape_is_known: bool, is_ordered: bool) -> float:
    """Return the work on a sequence without lost frames, in fits of one frame to which the body is followed."""
    finds = min(_SEEDS, frames) if is_ordered else frames + (0 if shape_is_known else min(_SHAPE_FRAMES, frames))
    rounds = 1 + is_ordered + (is_ordered and not shape_is_known)  # polished, followed, fitted again with the shape of all
    return _FIND_WORK * finds + rounds * frames


class _Tracker:
    """The best states of a sequence so far."""

    def __init__(
        self,
        surface: BodySurface,
        scans: Scans,
        finder: Finder,
        prior: PosePrior,
        clothes_m: float,
        progress: FrameProgress,
    ) -> None:
        self.surface, self.coarse = surface, surface.take(np.arange(min(_VERTICES, len(surface.points_rest))))
        self.scans, self.finder, self.prior, self.clothes_m = scans, finder, prior, clothes_m
        self.progress = progress
        self.betas = np.zeros(surface.num_betas)
        self.states: list[BodyState | None] = [None] * len(scans)
        self.misfit = np.full(len(scans), np.inf)
        self.seeds: list[int] = []
        self._finds_left = 2 + int(_FINDS_PER_FRAME * len(scans))
        self._loaded: dict[int, ScanPoints] = {}

    def scan(self, index: int) -> ScanPoints:
        if index not in self._loaded:
            self._loaded[index] = self.scans[index]
            while len(self._loaded) > 1 and sum(map(len, self._loaded.values())) > _KEPT_POINTS:
                del self._loaded[next(iter(self._loaded))]
        return self._loaded[index]

    def find_seeds(self, betas: Array | None, count: int) -> None:
        """Fit a few frames from nowhere; without `betas`, give them a shape in common."""
        count = min(count, len(self.scans))
        self.seeds = [(2 * number + 1) * len(self.scans) // (2 * count) for number in range(count)]
        found = [self._find(index, betas) for index in self.seeds]
        if betas is None:
            frames = [(self.scan(index), state) for index, state in zip(self.seeds, found, strict=True)]
            shape = fit_shape(self.coarse, frames, self.prior, clothes_m=self.clothes_m)
            self.betas, found = shape.betas, list(shape.states)
        else:
            self.betas = betas
        for index, state in zip(self.seeds, found, strict=True):
            self.offer(index, state)

    def find_each(self, betas: Array | None) -> None:
        """Fit every frame from nowhere, and the suspicious ones from those whose scans are like theirs."""
        self.find_seeds(betas, _SHAPE_FRAMES if betas is None else 0)
        for index in range(len(self.scans)):
            self.offer(index, self._found(index, ()))
        suspicious = is_suspicious(self.misfit)
        looks = np.stack([_look(self.scan(index)) for index in range(len(self.scans))])
        for index in np.flatnonzero(suspicious).tolist():
            apart = np.where(suspicious, np.inf, np.abs(looks - looks[index]).sum(1))
            for other in np.argsort(apart)[:_ALIKE].tolist():
                state = self._state(other)
                moved = replace(state, translation=state.translation + self.scan(index).centre - self.scan(other).centre)
                self.offer(index, self._fitted(index, moved, _WIDE_M))

    def follow_all(self) -> None:
        """Follow the body from the best seed through all frames, and from the others where they are better."""
        order = sorted(self.seeds, key=lambda index: self.misfit[index])
        seeds = {index: self.states[index] for index in order}
        for index in order[1:]:
            self.states[index], self.misfit[index] = None, np.inf
        self.follow(order[0])
        for index in order[1:]:
            state = seeds[index]
            if state is not None and self.offer(index, state):
                self.follow(index)

    def offer(self, index: int, state: BodyState) -> bool:
        """Keep a state if it is better than the one that is kept."""
        return self._keep(index, state, self._agreement(index, state).misfit)

    def follow(self, start: int) -> None:
        """Follow the body from a frame both ways, until that gains nothing."""
        for direction in (1, -1):
            before, last, same = None, self.states[start], 0
            index = start + direction
            while 0 <= index < len(self.scans) and same < _SAME and last is not None:
                before, (last, misfit) = last, self._next(index, before, last)
                same = 0 if self._keep(index, last, misfit) else same + 1
                index += direction

    def fit_shape(self) -> None:
        """Fit one shape to frames that differ."""
        good = np.flatnonzero(~is_suspicious(self.misfit))
        joints = np.stack([self.coarse.joints(self._state(int(index))) for index in good])
        chosen = good[different_frames(joints, _SHAPE_FRAMES)]
        frames = [(self.scan(index), self._state(int(index))) for index in chosen]
        self.betas = fit_shape(self.surface, frames, self.prior, clothes_m=self.clothes_m).betas
        for index in range(len(self.scans)):
            state = replace(self._state(index), betas=self.betas)
            self.states[index] = self._fitted(index, state, _POLISH_M)
            self.misfit[index] = self._agreement(index, self._state(index)).misfit

    def repair(self) -> bool:
        """Fit suspicious frames again; return whether one became better."""
        joints = np.stack([self.coarse.joints(self._state(index)) for index in range(len(self.scans))])
        suspicious = is_suspicious(self.misfit) | (find_jumps(joints) >= 0)
        is_better = False
        for first, last in _stretches(suspicious):
            is_better |= self._repair_stretch(first, last)
        return is_better

    def _repair_stretch(self, first: int, last: int) -> bool:
        before = self.misfit[first : last + 1].copy()
        for index in (first - 1, last + 1):
            if 0 <= index < len(self.scans):
                self.follow(index)
        worst = first + int(self.misfit[first : last + 1].argmax())
        if is_suspicious(self.misfit)[worst] and self._finds_left > 0:
            self._finds_left -= 1
            scan, state = self.scan(worst), self._state(worst)
            near = [self._state(index) for index in (first - 1, last + 1) if 0 <= index < len(self.scans)]
            is_better = self.offer(worst, self.finder.recover(scan, state, clothes_m=self.clothes_m).state)
            if is_better or self.offer(worst, self._found(worst, near)):
                self.follow(worst)
        return bool((self.misfit[first : last + 1] < before).any())

    def polished(self, *, is_ordered: bool = True) -> FittedSequence:
        """Fit all vertices to every frame, and judge the frames."""
        self.progress.start_last()
        states, agreements, apart = [], [], []
        for index in range(len(self.scans)):
            state = self._state(index)
            scan = self.scan(index).sided_by(self.surface.joints(state), self.surface.parents)
            if scan.is_estimated:
                state = fit_state(self.coarse, state, scan, _WIDE_M, self.prior, clothes_m=self.clothes_m)
                scan = scan.sided_by(self.surface.joints(state), self.surface.parents)
            state = fit_state(self.surface, state, scan, _POLISH_M, self.prior, clothes_m=self.clothes_m)
            states.append(state)
            found = agreement(self.surface, state, scan, clothes_m=self.clothes_m)
            if scan.is_estimated:
                found = with_matches_by_place(found, self.surface, state, scan)
            agreements.append(found)
            apart.append(apart_share(agreements[-1], self.surface.points_rest, scan.points, self.clothes_m))
            self.progress.add(1)
        self.progress.finish()
        residual_m = np.array([one.residual_m for one in agreements])
        joints = np.stack([self.surface.joints(state) for state in states])
        jumps = find_jumps(joints) if is_ordered else np.full(len(states), -1)
        misfit = np.array([one.misfit for one in agreements])
        reasons = judge(misfit, residual_m, np.array(apart), jumps, self.surface.joint_names)
        return FittedSequence(
            np.stack([state.pose for state in states]),
            np.stack([state.translation for state in states]),
            self.betas,
            residual_m,
            np.array([one.objective for one in agreements]),
            np.array([not reason for reason in reasons]),
            reasons,
            np.stack([unseen_joints(one.partners, self.surface) for one in agreements]),
        )

    def _next(self, index: int, before: BodyState | None, last: BodyState) -> tuple[BodyState, float]:
        """Fit a frame from the two states before it, of which the last is its neighbour's."""
        starts = [last] if before is None else [_continued(before, last), last]
        starts.sort(key=lambda state: self._agreement(index, state).misfit)
        state = self._fitted(index, starts[0], _FOLLOW_M)
        misfit = self._agreement(index, state).misfit
        if misfit > _LOST * self._usual():
            again = self._fitted(index, starts[-1], _WIDE_M)
            if (other := self._agreement(index, again).misfit) < misfit:
                return again, other
        return state, misfit

    def _found(self, index: int, near: Sequence[BodyState]) -> BodyState:
        return self._find(index, self.betas, near)

    def _find(self, index: int, betas: Array | None, near: Sequence[BodyState] = ()) -> BodyState:
        state = self.finder.find(self.scan(index), betas=betas, clothes_m=self.clothes_m, near=near).state
        self.progress.add(_FIND_WORK)
        return state

    def _usual(self) -> float:
        return float(np.median(self.misfit[np.isfinite(self.misfit)]))

    def _fitted(self, index: int, state: BodyState, scales_m: Array) -> BodyState:
        state = fit_state(self.coarse, state, self.scan(index), scales_m, self.prior, clothes_m=self.clothes_m)
        self.progress.add(1)
        return state

    def _agreement(self, index: int, state: BodyState) -> Agreement:
        return agreement(self.coarse, state, self.scan(index), clothes_m=self.clothes_m)

    def _keep(self, index: int, state: BodyState, misfit: float) -> bool:
        if misfit >= _BETTER * self.misfit[index]:
            return False
        self.states[index], self.misfit[index] = state, misfit
        return True

    def _state(self, index: int) -> BodyState:
        state = self.states[index]
        assert state is not None  # after follow_all
        return state


def _continued(before: BodyState, last: BodyState) -> BodyState:
    """Return the state to which a motion leads that goes on as between two states."""
    return BodyState(
        last.rotations @ before.rotations.transpose(0, 2, 1) @ last.rotations,
        2 * last.translation - before.translation,
        last.betas,
    )


def _look(scan: ScanPoints) -> Array:
    """Return numbers [24] by which scans can be compared: how the points are spread over height, width and depth, metres."""
    points = scan.points[:_LOOKS] - scan.centre
    return np.quantile(points, np.linspace(0, 1, 8), axis=0).reshape(-1)


def _stretches(chosen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last number of each run of chosen frames."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int)))
    return [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]
