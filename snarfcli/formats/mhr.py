"""MHR, the Momentum Human Rig (facebookresearch/MHR, Apache-2.0): a rig from the joints that SAM 3D Body writes.

Numbers, names, parents and rest orientations of the joints are facts about the rig. At rest the legs are slightly apart and the
arms hang at 45 degrees; x points along the bones of the left side and against those of the right. The orientations were checked
with the two files of the release: relative to them, knees, elbows and fingers turn about one axis only, within 0.1 degrees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.formats.rig import Rig, RigClip

__all__ = ["MHR_JOINTS", "MhrTable", "mhr_rig"]

Array = NDArray[np.float64]

MHR_JOINTS = 127
"""Joints of MHR, with those of twist, ends, tongue and teeth, which are left out here."""
# Number, number on the right side, name, parent, and the orientation at rest as axis-angle, radians.
_LEFT_AND_MIDDLE = (
    (1, 1, "root", "", 0.0000, 0.0000, 0.0000),
    (2, 18, "l_upleg", "root", -1.2254, 1.1719, -1.0551),
    (3, 19, "l_lowleg", "l_upleg", -1.2055, 1.1883, -1.0384),
    (4, 20, "l_foot", "l_lowleg", -1.2055, 1.1883, -1.0383),
    (5, 21, "l_talocrural", "l_foot", -1.2055, 1.1883, -1.0384),
    (6, 22, "l_subtalar", "l_talocrural", -0.1367, 1.5776, -0.1352),
    (7, 23, "l_transversetarsal", "l_subtalar", -0.1367, 1.5776, -0.1352),
    (8, 24, "l_ball", "l_transversetarsal", 0.0157, 1.8023, -0.0125),
    (34, 34, "c_spine0", "root", 1.1798, 1.2278, 1.1798),
    (35, 35, "c_spine1", "c_spine0", 1.1798, 1.2278, 1.1798),
    (36, 36, "c_spine2", "c_spine1", 1.1798, 1.2278, 1.1798),
    (37, 37, "c_spine3", "c_spine2", 1.1798, 1.2278, 1.1798),
    (74, 38, "l_clavicle", "c_spine3", 1.5489, 0.5115, -0.3928),
    (75, 39, "l_uparm", "l_clavicle", 1.0162, -0.5055, -0.7155),
    (76, 40, "l_lowarm", "l_uparm", 0.8019, -0.7808, -0.1858),
    (77, 41, "l_wrist_twist", "l_lowarm", 2.6024, -0.9162, 0.8149),
    (78, 42, "l_wrist", "l_wrist_twist", 2.6022, -0.9166, 0.8147),
    (79, 43, "l_pinky0", "l_wrist", 2.3633, -1.0780, 0.2242),
    (80, 44, "l_pinky1", "l_pinky0", 2.4912, -1.1653, 0.3665),
    (81, 45, "l_pinky2", "l_pinky1", 2.4761, -1.1555, 0.2064),
    (82, 46, "l_pinky3", "l_pinky2", 2.4623, -1.0548, 0.3116),
    (84, 48, "l_ring1", "l_wrist", 2.6194, -1.1315, 0.4580),
    (85, 49, "l_ring2", "l_ring1", 2.5595, -1.1438, 0.4080),
    (86, 50, "l_ring3", "l_ring2", 2.5470, -1.0567, 0.4627),
    (88, 52, "l_middle1", "l_wrist", 2.6204, -1.0904, 0.6993),
    (89, 53, "l_middle2", "l_middle1", 2.6085, -1.0888, 0.6714),
    (90, 54, "l_middle3", "l_middle2", 2.6142, -0.8416, 0.5705),
    (92, 56, "l_index1", "l_wrist", 2.6549, -1.0371, 0.8308),
    (93, 57, "l_index2", "l_index1", 2.6196, -1.0566, 0.7767),
    (94, 58, "l_index3", "l_index2", 2.6679, -0.8738, 0.6549),
    (96, 60, "l_thumb0", "l_wrist", -1.9951, 0.2726, -2.1672),
    (97, 61, "l_thumb1", "l_thumb0", -1.5260, -0.0398, -1.8812),
    (98, 62, "l_thumb2", "l_thumb1", -1.8294, -0.0871, -1.9326),
    (99, 63, "l_thumb3", "l_thumb2", -1.6184, -0.3097, -2.0520),
    (110, 110, "c_neck", "c_spine3", 1.4213, 1.0564, 1.4213),
    (113, 113, "c_head", "c_neck", 1.2092, 1.2092, 1.2092),
    (114, 114, "c_jaw", "c_head", 0.0000, 0.0000, 0.0000),
    (124, 122, "l_eye", "c_head", 0.0000, 0.0969, 0.0000),
)  # fmt: skip
# The axes of the right side are the mirrored and reversed ones of the left.
_MIRROR = np.diag([-1.0, 1.0, 1.0])
_ALONG_X = ("l_upleg", "l_lowleg", "l_uparm", "l_lowarm")  # joints whose only child of a kind lies on their x axis
_MAX_DISTANCE_M = 1e6
_MAX_DEVIATION = 0.2  # of a unit vector; body shapes move the axis of the thigh by 0.02


class MhrTable:
    """The joints that are kept: numbers in MHR, names, parents and orientations at rest."""

    def __init__(self) -> None:
        joints = []
        for number, mirrored, name, parent, *rest in _LEFT_AND_MIDDLE:
            rotation = Rotation.from_rotvec(rest).as_matrix()
            joints.append((number, name, parent, rotation))
            if mirrored != number:
                right = parent.replace("l_", "r_", 1) if parent.startswith("l_") else parent
                joints.append((mirrored, name.replace("l_", "r_", 1), right, -_MIRROR @ rotation))
        joints.sort(key=lambda joint: joint[0])
        self.numbers = [joint[0] for joint in joints]
        self.names = tuple(joint[1] for joint in joints)
        self.parents = tuple(self.names.index(joint[2]) if joint[2] else -1 for joint in joints)
        self.rest = np.stack([joint[3] for joint in joints])


def mhr_rig(rotations: Array, positions: Array, frame_rate: float, name: str) -> tuple[Rig, bool]:
    """Return the rig of a person that SAM 3D Body saw, with one clip, and whether y is known to point down.

    The rig is in the frame of the positions.

    SAM 3D Body turns the positions to the camera (y down) but leaves the rotations with y up; both that and files in which they
    agree are recognised by the directions of the limbs.

    Args:
        rotations: [T, 127, 3, 3], orientations of the joints.
        positions: [T, 127, 3], joints, metres.
        frame_rate: frames per second.
        name: name of the clip.

    Raises:
        ValueError: the rotations are none, or do not belong to the positions.
    """
    table = MhrTable()
    turns, places = rotations[:, table.numbers], positions[:, table.numbers]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(turns @ turns.transpose(0, 1, 3, 2) - np.eye(3)).max()
    if not error <= 1e-3 or np.linalg.det(turns).min() < 0:
        raise ValueError("wanted rotation matrices, got others")
    if not np.abs(places).max() < _MAX_DISTANCE_M:
        raise ValueError(f"wanted joints within {_MAX_DISTANCE_M / 1000:g} km, got others")
    turned = np.diag([1.0, -1.0, -1.0]) @ turns
    deviations = [_deviation(table, each, places) for each in (turned, turns)]
    if not min(deviations) < _MAX_DEVIATION:
        raise ValueError("wanted rotations that belong to the positions of the joints, got others")
    is_camera = deviations[0] <= deviations[1]
    turns = turned if is_camera else turns
    rest = np.tile(np.eye(4), (len(table.names), 1, 1))
    rest[:, :3, :3] = table.rest
    for joint, parent in enumerate(table.parents):
        if parent >= 0:
            offset = (turns[:, parent].transpose(0, 2, 1) @ (places[:, joint] - places[:, parent])[..., None]).mean((0, 2))
            rest[joint, :3, 3] = rest[parent, :3, 3] + table.rest[parent] @ offset
    world = np.tile(np.eye(4), (*turns.shape[:2], 1, 1))
    world[..., :3, :3], world[..., :3, 3] = turns, places
    return Rig(table.names, table.parents, rest, (RigClip(name, frame_rate, world),)), is_camera


def _deviation(table: MhrTable, turns: Array, places: Array) -> float:
    """Return the median distance between the x axes of the left limbs and the directions to their children, as unit vectors."""
    distances = []
    for name in _ALONG_X:
        joint = table.names.index(name)
        child = table.parents.index(joint)
        way = places[:, child] - places[:, joint]
        length = np.linalg.norm(way, axis=1, keepdims=True)
        distances.append(np.linalg.norm(way / np.maximum(length, 1e-12) - turns[:, joint, :, 0], axis=1))
    return float(np.median(distances))
