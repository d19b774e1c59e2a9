"""The stage of a sequence: cameras and floor in each frame, computed before the first frame is drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from snarfcli.meshing.mesh import Mesh
from snarfcli.models.trained_field import TrainedField
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.floor import Floor
from snarfcli.rendering.views import View

__all__ = ["CAMERAS", "Stage", "body_points", "set_stage"]

CAMERAS = ("still", "follow")
"""A fixed camera that sees the whole motion, and one that follows the body."""

# Points posed in all frames together, and in one frame; 3000 points are at most 2 cm apart on a body.
_POINTS_IN_ALL = 600_000
_POINTS_LEAST, _POINTS_MOST = 300, 3000
_FOLLOW_S = 0.4  # standard deviation: smooths out steps and swinging arms, but not a change of direction
_TURNS = 24  # angles at which a turntable must show the whole body
_HULL = 4000  # points that are turned
_LINES = 4  # approximate number of lines of the floor over the height of the body


@dataclass(frozen=True, eq=False)
class Stage:
    """A floor, and cameras at the same distance, so that sizes are comparable between views."""

    views: tuple[View, ...]
    """Sides to look from."""
    cameras: tuple[Camera, ...]
    """One for each view, at its start."""
    pivot: np.ndarray
    """[3] metres, centre of a turntable."""
    floor: Floor
    """The floor, at the lowest point of the sequence."""
    shifts: np.ndarray
    """[T, 3] metres, by which the cameras have followed the body."""
    turns_rad: np.ndarray
    """[T] angles by which the cameras have turned about the pivot."""
    heading_rad: float
    """Mean direction of the body, 0 for +z."""

    @property
    def is_still(self) -> bool:
        """Whether the cameras never move."""
        return not (self.shifts.any() or self.turns_rad.any())

    def camera(self, view: int, frame: int) -> Camera:
        """Return the camera of one view in one frame."""
        start, turn = self.cameras[view], _turned(float(self.turns_rad[frame]))
        moved = [self.pivot + turn @ np.subtract(place, self.pivot) for place in (start.position, start.target)]
        position, target = (place + self.shifts[frame] for place in moved)
        return start.between(position, target)

    def camera_on(self, view: int, frame: int, middle: np.ndarray) -> Camera:
        """Return the camera of one view, moved to look at `middle` [3] from the same distance and height."""
        camera = self.camera(view, frame)
        return _aimed(camera, np.array([middle[0], camera.target[1], middle[2]]))


@torch.no_grad()
def body_points(
    avatar: TrainedField,
    poses: np.ndarray,
    translation: np.ndarray,
    canonical_mesh: Mesh | None = None,
    bone_transforms: np.ndarray | None = None,
) -> np.ndarray:
    """Return points on the body in each frame, [T, K, 3] metres.

    Args:
        avatar: the body.
        poses: [T, J, 3] axis-angle, radians, y up, global orientation included.
        translation: [T, 3] metres.
        canonical_mesh: vertices to pose by skinning; without it the corners of the larger posed boxes are returned.
        bone_transforms: [T, J, 4, 4], canonical to posed, metres; by default those of the poses.
    """
    points_c = None
    if canonical_mesh is not None:
        count = int(np.clip(_POINTS_IN_ALL // len(poses), _POINTS_LEAST, _POINTS_MOST))
        some = np.linspace(0, len(canonical_mesh.vertices) - 1, min(count, len(canonical_mesh.vertices)))
        points_c = torch.from_numpy(canonical_mesh.vertices[some.astype(int)])
    points = []
    for frame, (pose, shift) in enumerate(zip(torch.from_numpy(poses), torch.from_numpy(translation), strict=True)):
        if bone_transforms is None:
            transforms = avatar.bone_transforms(pose[None].float(), shift[None].float())[0]
        else:
            transforms = torch.from_numpy(bone_transforms[frame])
        if points_c is not None:
            points.append(avatar.skin(points_c, transforms).cpu().numpy())
        else:
            lower, upper = (corner.cpu().numpy() for corner in avatar.posed_box(transforms))
            points.append(np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3))
    return np.stack(points).astype(np.float64)


def set_stage(
    points: np.ndarray,
    poses: np.ndarray,
    views: Sequence[View],
    *,
    frame_rate: float = 30.0,
    aspect: float = 1.0,
    camera: str = "still",
    turn_rad_s: float = 0.0,
    also: np.ndarray | None = None,
    beside: np.ndarray | None = None,
) -> Stage:
    """Find cameras that see the body in all frames, relative to its mean direction, and the floor below it.

    Args:
        points: [T, K, 3] metres, points of the body that must be in the picture (`body_points`).
        poses: [T, J, 3] axis-angle, radians, global orientation first, which gives the direction of the body.
        views: sides to look from.
        frame_rate: frames per second.
        aspect: width over height of one picture.
        camera: one of `CAMERAS`.
        turn_rad_s: speed of the camera around the body.
        also: [T, N, 3] metres, more points that must be in the picture, but are not followed.
        beside: [N, 3] metres, points of an object around x = z = 0 that must fit into a separate picture.
    """
    heading_rad = _heading_rad(poses)
    middle = points.mean(axis=1) * (1, 0, 1)
    shifts = np.zeros_like(middle) if camera == "still" else _smooth(middle, frame_rate)
    tall = float(np.median(np.ptp(points[..., 1], axis=1)))
    points = points if also is None else np.concatenate([points, also], axis=1)
    seen = (points - shifts[:, None]).reshape(-1, 3)
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    pivot = (lower + upper) / 2
    if turn_rad_s:
        seen = _all_ways_round(seen, pivot)
        beside = None if beside is None else _all_ways_round(beside, np.zeros(3))

    def framing(what: np.ndarray, view: View) -> Camera:
        azimuth_rad = heading_rad + view.azimuth_rad
        return Camera.framing(what, aspect=aspect, azimuth_rad=azimuth_rad, elevation_rad=view.elevation_rad)

    cameras = [framing(seen, view) for view in views]
    others = [] if beside is None else [framing(beside, view) for view in views]
    # Side by side, the floor should be at one height.
    pairs = [*zip(cameras, views, strict=True), *zip(others, views, strict=False)]
    heights = [one.target[1] for one, view in pairs if not view.is_from_above]
    for index, (one, view) in enumerate(zip(cameras, views, strict=True)):
        x, y, z = one.target
        target = np.array([x, y if view.is_from_above else float(np.mean(heights)), z])
        if turn_rad_s:
            target[[0, 2]] = pivot[[0, 2]]
        cameras[index] = _aimed(one, target)
    distances = [one.distance_to_see(seen, aspect=aspect) for one in cameras]
    if beside is not None:
        aimed = [_aimed(one, np.array([0.0, one.target[1], 0.0])) for one in cameras]
        distances += [one.distance_to_see(beside, aspect=aspect) for one in aimed]
    cameras = [one.at(max(distances)) for one in cameras]
    moves = camera != "still" or bool(turn_rad_s)
    return Stage(
        tuple(views),
        tuple(cameras),
        pivot,
        Floor(float(points[..., 1].min()), _round_number(tall / _LINES) if moves else None),
        shifts,
        turn_rad_s * np.arange(len(points)) / frame_rate,
        heading_rad,
    )


def _aimed(camera: Camera, target: np.ndarray) -> Camera:
    """Return the camera moved so that it looks at another point in the same direction."""
    return camera.between(target + np.subtract(camera.position, camera.target), target)


def _smooth(places: np.ndarray, frame_rate: float) -> np.ndarray:
    """Return a smoothed path [T, 3]; at its ends the path is extended by point reflection."""
    from scipy.ndimage import gaussian_filter1d

    sigma = _FOLLOW_S * frame_rate
    room = math.ceil(4 * sigma)
    if len(places) < 2:
        return places.copy()
    longer = np.pad(places, np.array([(room, room), (0, 0)]), mode="reflect", reflect_type="odd")
    return gaussian_filter1d(longer, sigma, axis=0, mode="nearest")[room:-room]


def _all_ways_round(points: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """Return a subset of points [N, 3] turned about the vertical through `pivot` by angles all around."""
    some = points[:: max(1, len(points) // _HULL)] - pivot
    turns = [_turned(2 * math.pi * turn / _TURNS) for turn in range(_TURNS)]
    return np.concatenate([some @ turn.T + pivot for turn in turns])


def _turned(angle_rad: float) -> np.ndarray:
    """Return the rotation [3, 3] about the vertical that takes +z towards +x."""
    sin, cos = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


def _round_number(value: float) -> float:
    """Return the nearest of ..., 0.1, 0.2, 0.5, 1, 2, 5, ..."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-3)))
    return min((power * digit for digit in (1, 2, 5, 10)), key=lambda candidate: abs(math.log(candidate / max(value, 1e-3))))


def _heading_rad(poses: np.ndarray) -> float:
    """Return the mean direction of the body, 0 for +z; 0 also if the body turns all around."""
    from scipy.spatial.transform import Rotation

    ahead = Rotation.from_rotvec(poses[:, 0]).apply((0.0, 0.0, 1.0)).mean(axis=0)
    return math.atan2(ahead[0], ahead[2]) if math.hypot(ahead[0], ahead[2]) > 0.2 else 0.0
