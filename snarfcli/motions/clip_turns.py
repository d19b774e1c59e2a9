"""Limbs whose rest pose is not that of a standing person: find their rotations from the frames of a clip instead.

Many rigs rest with all bones along one axis, whole or limb by limb (motion-capture suits, game engines, research data). Such a
rest pose tells nothing about how a bone is twisted about itself. The posed frames do: on average a limb is not twisted against
the trunk, and knees and elbows bend about their hinges.

Let R_S be the world rotation of a joint of the rig relative to its rest. For every frame an expected world rotation E of the
joint of the skeleton is made from places alone: the smallest rotation of its parent that points the bone as in the frame. All
estimates inv(R_S) E of one bone agree in its direction; their weighted mean tells the twist. For thighs and upper arms, E comes
from the hinge instead if it is ever seen bent. Else frames in which the bone is near its rest direction weigh most, since there
the smallest rotation is most reliable.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies.kinematics import nearest_rotation
from snarfcli.motions.rest_match import LIMB_ROOTS, RestMatch, body_frame, frame_of, smallest_turn, unit

__all__ = ["all_limbs", "clip_turns", "disputed_limbs", "doubtful_limbs", "false_toes"]

Array = NDArray[np.float64]

_MAX_FRAMES = 300  # that are looked at, spread over the clip
_COS_60, _COS_45 = 0.5, np.sqrt(0.5)
_NEAR_RAD = np.radians(20)  # in frames within this angle of its rest direction, the twist of a bone is reliable
_BENT_SINE = np.sin(np.radians(25))  # a knee or elbow that is bent more tells the direction of its hinge
_SOLE_COS = np.cos(np.radians(35))  # toes within this angle of the shin's direction are none
_TOES_BEND_COS = np.cos(np.radians(80))  # End Sites of toes at a larger angle to the foot point anywhere


def all_limbs(match: RestMatch) -> list[str]:
    """Return "trunk" and the names of `LIMB_ROOTS` that a human skeleton and the rig have; nothing for other skeletons."""
    return [] if body_frame(match.points(0)) is None else ["trunk", *(name for name in LIMB_ROOTS if match.limb(name))]


def doubtful_limbs(match: RestMatch) -> tuple[list[str], list[str]]:
    """Return which parts of a human rig, of `all_limbs`, do not rest as in a standing person, and which may not.

    Legs must point down. Arms may hang, or be raised sideways up to 45 degrees above the horizontal; arms that point forwards
    or further up may be as they seem, or be twisted in any way. So may limbs that seem right where others are not. A limb is
    judged with its opposite one. If the trunk is wrong, the limbs cannot be judged, so that all are. Nothing is wrong if the
    skeleton itself does not rest as a standing person.
    """
    limbs = all_limbs(match)
    if not limbs or _doubtful_kinds(match, 0):
        return [], []
    kinds = _doubtful_kinds(match, 1)
    if "trunk" in kinds:
        return limbs, []
    wrong = [name for name in limbs if name[2:] in kinds]
    frame = body_frame(match.points(1))
    assert frame is not None  # else the trunk is wrong
    is_odd = bool(wrong) or not _arms_rest(match.points(1), frame, _COS_45)
    others = [name for name in limbs if name not in wrong and (wrong or name[2:] == "arm") and name != "trunk"]
    return wrong, others if is_odd else []


def _doubtful_kinds(match: RestMatch, side: int) -> list[str]:
    """Return which of trunk, arm and leg do not rest as in a standing person; `side` is 0 for the skeleton, 1 for the rig."""
    points = match.points(side)
    frame = body_frame(points)
    if frame is None or not _trunk_stands(points, match.spine_points(side), frame[:, 1]):
        return ["trunk"]
    fine = {"arm": _arms_rest(points, frame, 2.0), "leg": _legs_rest(points, frame)}
    return [kind for kind, is_fine in fine.items() if not is_fine]


def _trunk_stands(points: Mapping[str, Array], spine: Sequence[Array], up: Array) -> bool:
    """Whether hips lie beside each other, and all bones from hips to neck point up within 60 degrees."""
    top = points.get("neck", points.get("head"))
    chain = [(points["l_hip"] + points["r_hip"]) / 2, *spine]
    if top is not None:
        chain.append(top)
    places = np.stack(chain)
    bones = places[1:] - places[:-1]
    lengths = np.linalg.norm(bones, axis=1)
    hips = points["l_hip"] - points["r_hip"]
    if not abs(hips @ up) <= _COS_45 * np.linalg.norm(hips) or not np.linalg.norm(hips) > 0.02 * lengths.sum():
        return False
    return bool((bones @ up > _COS_60 * lengths)[lengths > 0.1 * lengths.sum()].all())


def _legs_rest(points: Mapping[str, Array], frame: Array) -> bool:
    """Whether the bones of both legs point down within 60 degrees."""
    bones = (("hip", "knee"), ("knee", "ankle"))
    directions = [direction for side in "lr" for direction in _directions(points, side, bones)]
    return all(-(direction @ frame[:, 1]) > _COS_60 for direction in directions)


def _arms_rest(points: Mapping[str, Array], frame: Array, most: float) -> bool:
    """Whether both arms are straight, on their own side, not backwards, and up or forwards by at most the cosine `most`."""
    for side, sign in (("l", 1), ("r", -1)):
        directions = _directions(points, side, (("shoulder", "elbow"), ("elbow", "wrist")))
        if not directions:
            continue
        left, up, forward = directions[0] @ frame
        if max(up, forward) > most or sign * left < -_COS_60 or forward < -_COS_45:
            return False
        if len(directions) == 2 and directions[0] @ directions[1] < 0:
            return False
    return True


def _directions(points: Mapping[str, Array], side: str, bones: Collection[tuple[str, str]]) -> list[Array]:
    named = [(f"{side}_{upper}", f"{side}_{lower}") for upper, lower in bones]
    directions = [unit(points[lower] - points[upper]) for upper, lower in named if upper in points and lower in points]
    return [direction for direction in directions if np.isfinite(direction).all()]


def false_toes(match: RestMatch, posed: Array) -> set[int]:
    """Return the ankles of the skeleton whose toes in the rig are none: joints that stay below the ankle, as soles do.

    Args:
        match: the paired joints at rest.
        posed: [T, K, 3], places of the joints of the rig in the frames of a clip.
    """
    ankles = set()
    for side in "lr":
        joints = [match.parts.get(f"{side}_{part}", -1) for part in ("knee", "ankle", "foot")]
        if not all(joint in match.pairs for joint in joints):
            continue
        knee, ankle, toe = (_some(posed[:, match.pairs[joint]]) for joint in joints)
        cosine = (unit(ankle - knee) * unit(toe - ankle)).sum(-1)
        if np.median(cosine) > _SOLE_COS:
            ankles.add(joints[1])
    return ankles


def clip_turns(
    match: RestMatch,
    doubtful: Collection[str],
    turns: Mapping[int, Array],
    rotations: Mapping[int, Array],
    posed: Array,
) -> dict[int, Array]:
    """Return the rotations from the rest pose of the skeleton to that of the rig, for the joints of doubtful limbs.

    Args:
        match: the paired joints at rest.
        doubtful: as from `doubtful_limbs`.
        turns: [3, 3] per paired joint, as from `rest_turns`; used for the joints that are not in doubt.
        rotations: [T, 3, 3] per paired joint of the skeleton, world rotations of the rig's joint relative to its rest, T > 0.
        posed: [T, K, 3], places of the joints of the rig.

    Returns:
        [3, 3] per paired joint of the doubtful limbs.
    """
    limbs = {joint for name in doubtful if name in LIMB_ROOTS for joint in match.limb(name)}
    joints = set(match.pairs) if "trunk" in doubtful else limbs
    rotations = {joint: _some(rotations[joint]) for joint in match.pairs}
    frames = _Frames(match, _some(posed))
    found: dict[int, Array] = {}
    for joint in match.pairs:
        if joint not in joints:
            continue
        above = match.above.get(joint)
        parent = None if above is None else rotations[above] @ (found[above] if above in found else turns[above])
        expected, weights = frames.expected(joint, parent)
        estimates = rotations[joint].transpose(0, 2, 1) @ expected
        mean = np.tensordot(weights / weights.sum(), estimates, 1)
        found[joint] = nearest_rotation(torch.from_numpy(mean)).numpy()
    return found


def disputed_limbs(
    match: RestMatch, limbs: Collection[str], turns: Mapping[int, Array], found: Mapping[int, Array]
) -> list[str]:
    """Return the limbs, with their opposite ones, in which the clip contradicts the rest pose by more than 45 degrees.

    Args:
        match: the paired joints at rest.
        limbs: which limbs are judged.
        turns: as from `rest_turns`.
        found: as from `clip_turns`.
    """
    kinds = set()
    for name in limbs:
        joint = match.parts.get(f"{name[0]}_{'hip' if name.endswith('leg') else 'shoulder'}", -1)
        if joint in found and np.trace(turns[joint].T @ found[joint]) < 1 + 2 * _COS_45:
            kinds.add(name[2:])
    return [name for name in limbs if name[2:] in kinds]


def _some(frames: Array) -> Array:
    """Return at most `_MAX_FRAMES` of T frames, spread evenly."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, _MAX_FRAMES).round().astype(int))
    return frames[chosen]


class _Frames:
    """Expected world rotations of the skeleton's joints in the frames of a clip, from the places of the rig's joints."""

    def __init__(self, match: RestMatch, posed: Array) -> None:
        self.match, self.posed = match, posed
        rest = body_frame(match.points(0))
        assert rest is not None  # else no limb is doubtful
        self.rest_frame = rest

    def expected(self, joint: int, parent: Array | None) -> tuple[Array, Array]:
        """Return the rotations [T, 3, 3] of a joint and the weight [T] of each, for its parent's rotations [T, 3, 3]."""
        match, part = self.match, self.match.names.get(joint, "")
        is_chest = bool(match.spine) and joint == match.spine[-1]
        even = np.ones(len(self.posed))
        if parent is None or part == "pelvis" or is_chest:
            frame = self._trunk_frame("shoulder" if is_chest else "hip")
            if frame is not None:
                return frame, even
        if parent is None:
            return np.tile(np.eye(3), (len(self.posed), 1, 1)), even
        bone = self._posed_bone(joint)
        if bone is None or part[2:] == "collar" or part in ("neck", "head", "jaw"):
            return parent, even
        before, after = parent @ bone[0], bone[1]
        swing = smallest_turn(before, after) @ parent
        weights = _nearness(np.arccos(np.clip((before * after).sum(-1), -1, 1)))
        if part[2:] in ("hip", "shoulder"):
            return self._hinged(part, bone) or (swing, weights)
        return swing, weights

    def _posed_bone(self, joint: int) -> tuple[Array, Array] | None:
        """Return the direction of a bone in the skeleton at rest [3], and in the frames of the rig [T, 3]; None without one."""
        match, at = self.match, self.posed[:, self.match.pairs[joint]]
        ends = match.bone_ends(joint)
        if ends is not None:
            rest, posed = unit(match.target[ends[0]].mean(0) - match.target[joint]), unit(self.posed[:, ends[1]].mean(1) - at)
        elif match.names.get(joint, "")[2:] == "foot":
            # toes point forwards at rest, and in the rig to their End Site, if that continues the foot
            tips = [tip for tip, parent in enumerate(match.source_parents) if parent == match.pairs[joint]]
            if len(tips) != 1 or joint not in match.above:
                return None
            rest, posed = self.rest_frame[:, 2], unit(self.posed[:, tips[0]] - at)
            foot = unit(at - self.posed[:, match.pairs[match.above[joint]]])
            if not np.median((foot * posed).sum(-1)) > _TOES_BEND_COS:
                return None
        else:
            return None
        return (rest, posed) if np.isfinite(rest).all() and np.isfinite(posed).all() else None

    def _trunk_frame(self, part: str) -> Array | None:
        """Return rotations [T, 3, 3] of pelvis or chest from hips or shoulders and the spine; None if unknown."""
        names = (f"l_{part}", f"r_{part}", "l_hip", "r_hip", "neck" if "neck" in self.match.points(0) else "head")
        rest, places = self.match.points(0), self.match.names
        if not all(name in rest for name in names):
            return None
        joints = {name: joint for joint, name in places.items()}
        posed = {name: self.posed[:, self.match.pairs[joints[name]]] for name in names}
        frames = [
            frame_of(points[names[0]] - points[names[1]], points[names[4]] - (points["l_hip"] + points["r_hip"]) / 2)
            for points in (rest, posed)
        ]
        turns = frames[1] @ frames[0].T
        return turns if np.isfinite(turns).all() else None

    def _hinged(self, part: str, bone: tuple[Array, Array]) -> tuple[Array, Array] | None:
        """Return rotations of thigh or upper arm from the hinge of knee or elbow, and weights; None if it never bends."""
        lower = {"hip": "knee", "shoulder": "elbow"}[part[2:]]
        joint = self.match.parts.get(f"{part[0]}_{lower}", -1)
        below = self._posed_bone(joint) if joint in self.match.pairs else None
        if below is None:
            return None
        hinge = np.cross(bone[1], below[1])  # its length is the sine of the bend
        sine = np.linalg.norm(hinge, axis=-1)
        if not sine.max() > _BENT_SINE:
            return None
        forward = self.rest_frame[:, 2] if lower == "elbow" else -self.rest_frame[:, 2]
        rest = _columns(bone[0], np.cross(bone[0], forward))
        bent = sine > 0.5 * sine.max()
        turns = _columns(bone[1], np.where(bent[:, None], hinge, bone[1][:, [1, 2, 0]])) @ rest.T
        return turns, np.where(bent, sine**2, 0.0)


def _nearness(angles: Array) -> Array:
    """Return weights [T] of frames by the angle of a bone to its rest direction: 1 up to 20 degrees, then falling."""
    return np.exp(-np.maximum(angles**2 - _NEAR_RAD**2, 0) / (2 * _NEAR_RAD**2)) + 1e-12


def _columns(along: Array, across: Array) -> Array:
    """Return orthonormal frames [..., 3, 3]; the first column is `along` [..., 3], the second close to `across`."""
    second = unit(across - (along * across).sum(-1, keepdims=True) * along)
    return np.stack([along, second, np.cross(along, second)], -1)
