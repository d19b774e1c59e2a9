"""Follow a body through frames that share one topology, such as registrations, simulations and exported animations.

The vertices are attached to the body in a frame whose pose is known. Their positions in the other frames determine the poses
there, in closed form and by a few steps (`known_pairs`); their motion determines the shape and the positions of the joints
(`attachment`). Frames of the body's own topology need no known pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.attachment import AttachedPoints, attach, refine, with_mean_offsets
from snarfcli.registration.body_surface import BodyState, BodySurface, farthest_points
from snarfcli.registration.known_pairs import KnownPairs, PairedPoses
from snarfcli.registration.rotations import matrix_to_vector
from snarfcli.registration.tracker import FittedSequence, Found

__all__ = [
    "OTHERS",
    "EdgeLengths",
    "NoUsualFrames",
    "TopologyFollower",
    "fit_one_topology",
    "is_own_topology",
    "prepare_follower",
]

Array = NDArray[np.float64]
Load = Callable[[int], NDArray]
"""Returns the vertices [V, 3] of a frame, metres."""
Refit = Callable[[int, Sequence[BodyState]], Found | None]
"""Fits a frame to its points alone, given its number and the states of the nearest known frames before and after it."""

_POINTS = 2000  # vertices of a frame that are followed
_PROBES = 40  # frames, evenly spread, of which the most different serve to find shape and offsets
_KEY_FRAMES = 10
_FIRST = 5  # frames, one of which is that to which the others are compared
_EDGES = 2000  # that are measured in every frame
_STRETCHED = 2.0  # an edge that is longer or shorter by this factor does not join the same two points of a surface
_MOST_STRETCHED = 0.1  # share of such edges; cloth of simulations and skin near joints have 1 %
_EXACT_M = 1e-3  # points that are so close to the body's own vertices have no offsets
_LOST_M = 0.02  # a mean distance from the points to their places on the body from which on a frame is not trusted,
_LOST_RATIO = 3.0  # if it is also this many times the residual of the frames it was prepared from
_OBJECTIVE_M = 0.05  # as in `solver.agreement`
OTHERS = "its vertices are others than those of the other frames"
"""Reason why a frame is not trusted."""


class NoUsualFrames(ValueError):
    """No frame with a known state, or none at all, has the vertices that most frames have."""


class EdgeLengths:
    """Notices frames whose vertices are others than, or in another order than, those of a first frame.

    Args:
        vertices: [V, 3], of the first frame.
        faces: [F, 3].

    Attributes:
        vertices: V.
    """

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        self.vertices = len(vertices)
        some = np.linspace(0, len(faces) - 1, min(_EDGES, len(faces))).astype(np.intp)
        self._edges = np.unique(np.sort(np.concatenate([faces[some][:, :2], faces[some][:, 1:]]), 1), axis=0)
        self._lengths = self._measured(vertices)

    def fit(self, vertices: NDArray) -> bool:
        """Return whether the edges of a frame are about as long as those of the first."""
        if vertices.shape != (self.vertices, 3) or not np.isfinite(vertices).all():
            return False
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self._measured(vertices) / self._lengths
        is_kept = (ratio < _STRETCHED) & (ratio > 1 / _STRETCHED) | ~np.isfinite(ratio)
        return float(1 - is_kept.mean()) <= _MOST_STRETCHED

    def _measured(self, vertices: NDArray) -> Array:
        ends = np.asarray(vertices, np.float64)[self._edges]
        return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)


def is_own_topology(body_faces: NDArray, vertices: int, faces: NDArray) -> bool:
    """Return whether frames with these faces [F, 3], and a number of vertices, are those of the body itself."""
    return vertices == body_faces.max() + 1 and body_faces.shape == faces.shape and np.array_equal(body_faces, faces)


@dataclass(frozen=True, eq=False)
class TopologyFollower:
    """Follows vertices that are attached to a body of one shape; can be sent to other processes."""

    attached: AttachedPoints
    """The vertices that are followed."""
    betas: Array
    """[S], shape parameters of the body."""
    edges: EdgeLengths
    """Of the frame to which the others are compared."""
    residual_m: float
    """Mean distance of the vertices from their places on the body in a usual frame, metres."""

    def follow(
        self,
        load: Load,
        count: int,
        *,
        refit: Refit | None = None,
        on_frame: Callable[[int], None] | None = None,
    ) -> FittedSequence:
        """Fit the poses of one sequence.

        Args:
            load: returns the vertices [V, 3] of a frame, metres.
            count: T, number of frames.
            refit: fits frames whose vertices are others; without it, they have the pose of a neighbour and are not trusted.
            on_frame: told the number of each frame that is done.

        Raises:
            NoUsualFrames: no frame has the vertices of the first.
        """
        pairs = KnownPairs(self.attached.surface, self.betas, self.attached.importance)
        tell = on_frame or (lambda frame: None)
        rotations = np.tile(np.eye(3), (count, self.attached.surface.num_joints, 1, 1))
        translation, residual, objective = np.zeros((count, 3)), np.full(count, np.nan), np.full(count, np.nan)
        for frames, points in _chunks(load, count, self.edges, self.attached.surface.vertex_numbers, pairs.frames_at_once):
            found = pairs.find(points)
            rotations[frames], translation[frames] = found.rotations, found.translation
            residual[frames] = found.distances @ pairs.importance
            squared = np.square(found.distances)
            objective[frames] = 2 * (squared / (squared + _OBJECTIVE_M**2)) @ pairs.importance
            for frame in frames:
                tell(int(frame))
        is_known = np.isfinite(residual)
        if not is_known.any():
            raise NoUsualFrames("frames: wanted some with the vertices of the first, got none")
        limit = max(_LOST_M, _LOST_RATIO * self.residual_m)
        reasons = [
            OTHERS if not known else f"{1000 * apart:.0f} mm from the body on average" if apart > limit else ""
            for known, apart in zip(is_known, residual, strict=True)
        ]
        for frame in np.flatnonzero(~is_known).tolist():
            near = [BodyState(rotations[other], translation[other], self.betas) for other in _neighbours(is_known, frame)]
            state = near[0]
            if refit is not None and (again := refit(frame, near)) is not None:
                state, reasons[frame] = again.state, ""
                residual[frame], objective[frame] = again.agreement.residual_m, again.agreement.objective
            rotations[frame], translation[frame] = state.rotations, state.translation
            tell(frame)
        is_trusted = np.array([not reason for reason in reasons])
        return FittedSequence(
            matrix_to_vector(rotations),
            translation,
            self.betas,
            residual,
            objective,
            is_trusted,
            tuple(reasons),
            np.zeros(rotations.shape[:2], bool),
        )


def fit_one_topology(
    surface: BodySurface,
    surface_faces: NDArray,
    faces: NDArray,
    load: Load,
    count: int,
    anchors: Mapping[int, BodyState],
    *,
    betas: Array | None = None,
    clothes_m: float = 0.0,
    refit: Refit | None = None,
    on_frame: Callable[[int], None] | None = None,
) -> FittedSequence:
    """Fit the poses of a sequence whose frames share one topology.

    Args:
        surface: all vertices of the body.
        surface_faces: [F', 3], its faces.
        faces: [F, 3], of all frames.
        load: returns the vertices [V, 3] of a frame, metres, y up.
        count: T, number of frames.
        anchors: states of some frames, by number; none are needed for the body's own topology.
        betas: [S], shape parameters; without them the shape is found.
        clothes_m: how far the body may be below the surface, metres.
        refit, on_frame: see `TopologyFollower.follow`.

    Raises:
        NoUsualFrames: none of the anchors is a usual frame, and the topology is not the body's own; or no frame is usual.
    """
    probes = np.unique(np.linspace(0, count - 1, _PROBES).round().astype(int))
    numbers = [*anchors, *(int(probe) for probe in probes if int(probe) not in anchors)]
    follower = prepare_follower(
        surface,
        surface_faces,
        faces,
        [load(number) for number in numbers],
        list(anchors.values()),
        betas=betas,
        clothes_m=clothes_m,
    )
    return follower.follow(load, count, refit=refit, on_frame=on_frame)


def prepare_follower(
    surface: BodySurface,
    surface_faces: NDArray,
    faces: NDArray,
    frames: Sequence[NDArray],
    states: Sequence[BodyState],
    *,
    betas: Array | None = None,
    clothes_m: float = 0.0,
) -> TopologyFollower:
    """Attach vertices to the body by some frames, which may be of several sequences of one subject.

    Args:
        surface: all vertices of the body.
        surface_faces: [F', 3], its faces.
        faces: [F, 3], of all frames.
        frames: vertices [V, 3] of N frames, some tens, metres, y up.
        states: of the first of these frames; may be empty for the body's own topology.
        betas: [S], shape parameters; without them the shape is found.
        clothes_m: how far the body may be below the surface, metres.

    Raises:
        NoUsualFrames: none of the states is of a usual frame, and the topology is not the body's own; or no frame has the
            vertices of the faces.
    """
    edges = _usual_edges(frames, faces)
    is_known = [edges.fit(vertices) for vertices in frames]
    states = [state for state, known in zip(states, is_known, strict=False) if known]
    is_own = is_own_topology(surface_faces, edges.vertices, faces)
    if not is_own and not states:
        raise NoUsualFrames("states: wanted those of some frames, since the topology is not that of the body, got none")
    frames = [np.asarray(vertices, np.float64) for vertices, known in zip(frames, is_known, strict=True) if known]
    if betas is not None:
        shape = betas
    else:
        shape = np.mean([state.betas for state in states], 0) if states else np.zeros(surface.num_betas)
    states = [BodyState(state.rotations, state.translation, shape) for state in states]
    attached = (
        AttachedPoints.own(surface, _POINTS) if is_own else attach(surface, states, frames[: len(states)], faces, _POINTS)
    )
    points = np.stack([vertices[attached.surface.vertex_numbers] for vertices in frames])
    if not is_own:
        attached = with_mean_offsets(attached, states, points[: len(states)], 0.0)
    found = KnownPairs(attached.surface, shape).find(points)
    key = _key_frames(found)
    key_states, key_points = [found.state(int(frame), shape) for frame in key], points[key]
    is_exact = False
    if is_own:
        attached, key_states = refine(attached, key_states, key_points, None, shape_is_free=betas is None)
        is_exact = _mean_distance(attached, key_states[0].betas, key_points) < _EXACT_M
    if not is_exact:
        attached, key_states = refine(
            attached, key_states, key_points, surface, shape_is_free=betas is None, clothes_m=clothes_m
        )
    shape = key_states[0].betas
    return TopologyFollower(attached, shape, edges, _mean_distance(attached, shape, points))


def _usual_edges(frames: Sequence[NDArray], faces: NDArray) -> EdgeLengths:
    """Return the edges of the one of the first frames that most frames agree with."""
    whole = [vertices for vertices in frames if len(vertices) > faces.max() and np.isfinite(vertices).all()]
    if not whole:
        raise NoUsualFrames(f"frames: wanted finite vertices, more than {faces.max()}, got none")
    tries = [EdgeLengths(vertices, faces) for vertices in whole[:_FIRST]]
    return max(tries, key=lambda edges: sum(edges.fit(vertices) for vertices in frames))


def _mean_distance(attached: AttachedPoints, betas: Array, points: Array) -> float:
    """Return the mean distance of points [T, K, 3] from their places on the body in most frames, metres."""
    pairs = KnownPairs(attached.surface, betas, attached.importance)
    return float(np.median(pairs.find(points).distances @ pairs.importance))


def _chunks(
    load: Load, count: int, edges: EdgeLengths, chosen: NDArray[np.intp], size: int
) -> Iterator[tuple[NDArray[np.intp], Array]]:
    """Yield the numbers and the chosen vertices [N, K, 3] of frames that have the vertices of the first, some at a time."""
    numbers: list[int] = []
    points: list[Array] = []
    for frame in range(count):
        vertices = load(frame)
        if edges.fit(vertices):
            numbers.append(frame)
            points.append(np.asarray(vertices[chosen], np.float64))
        if numbers and (len(numbers) == size or frame == count - 1):
            yield np.array(numbers), np.stack(points)
            numbers, points = [], []


def _neighbours(is_known: NDArray[np.bool_], frame: int) -> list[int]:
    """Return the nearest known frames before and after a frame, the nearer first."""
    known = np.flatnonzero(is_known)
    around = [*known[known < frame][-1:], *known[known > frame][:1]]
    return sorted((int(other) for other in around), key=lambda other: abs(other - frame))


def _key_frames(found: PairedPoses) -> NDArray[np.intp]:
    """Return the numbers of frames whose poses differ most, among those in which most points are about in their places."""
    apart = found.distances.mean(1)
    good = np.flatnonzero(apart <= np.maximum(2 * np.median(apart), _LOST_M))
    return good[farthest_points(found.rotations[good].reshape(len(good), -1), _KEY_FRAMES)]
