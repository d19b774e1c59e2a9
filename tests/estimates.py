"""Made-up results of video estimators: GVHMR's and WHAM's SMPL parameters, and the joints of MHR that SAM 3D Body writes."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from snarfcli.formats.mhr import MHR_JOINTS, MhrTable

__all__ = ["camera_poses", "gvhmr", "mhr_person", "rezipped", "saved", "wham"]

CAMERA = Rotation.from_euler("x", 180, degrees=True)  # from y up to the frame of a camera: y down, z forward


def camera_poses(poses):
    """Return poses [T, J, 3] with y up as a camera sees them."""
    seen = poses.copy()
    seen[:, 0] = (CAMERA * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return seen


def gvhmr(poses, way):
    """Return the content of `hmr4d_results.pt` for poses [T, 24, 3] and translation [T, 3]."""

    def parameters(each, place):
        flat = torch.from_numpy(each.reshape(len(each), 72)).float()
        return {
            "body_pose": flat[:, 3:66],
            "betas": torch.zeros(len(each), 10),
            "global_orient": flat[:, :3],
            "transl": torch.from_numpy(place).float(),
        }

    far = np.tile([0.0, 0.0, 4.0], (len(poses), 1))
    batch = {key: value[None] for key, value in parameters(poses, way).items()}
    return {
        "smpl_params_incam": parameters(camera_poses(poses), far),
        "smpl_params_global": parameters(poses, way),
        "K_fullimg": torch.eye(3).expand(len(poses), 3, 3),
        "net_outputs": {"model_output": {"pred_cam": torch.zeros(1, len(poses), 3)}, "pred_smpl_params_global": batch},
    }


def wham(poses, way):
    """Return the result of WHAM for one person."""
    seen = camera_poses(poses).reshape(len(poses), 72)
    world = {"pose_world": poses.reshape(len(poses), 72), "trans_world": way}
    return {"pose": seen, "trans": np.add(way, (0, 0, 4)), **world, "betas": np.zeros((len(poses), 10))}


def saved(content, *, is_zip=True):
    """Return the bytes of `torch.save`."""
    buffer = io.BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=is_zip)
    return buffer.getvalue()


def rezipped(content, change):
    """Return a zip archive with other bytes in its members: `change` takes a name and bytes and returns bytes, or None."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(buffer, "w") as new:
        for member in old.infolist():
            data = change(member.filename, old.read(member))
            if data is not None:
                new.writestr(member.filename, data)
    return buffer.getvalue()


# Places of MHR's joints at rest relative to their parents, metres: along x of the parent, or as given with y up.
_ALONG = {"upleg": 0.42, "lowleg": 0.39, "uparm": 0.26, "lowarm": 0.23}
_OFFSETS = {
    "root": (0, 0.92, 0), "upleg": (0.08, -0.02, 0.01), "ball": (0, -0.02, 0.1), "clavicle": (0.03, 0.06, 0.03),
    "uparm": (0.13, 0.01, -0.1), "c_spine0": (0, 0.03, -0.03), "c_neck": (0, 0.12, 0.02), "c_head": (0, 0.11, 0.04),
}  # fmt: skip


def mhr_person(turns=None, frames=1, place=(0.0, 1.0, 5.0)):
    """Return what SAM 3D Body writes of one person, with an axis of frames.

    Args:
        turns: rotation by name of the joint, relative to its rest, in its own axes.
        frames: T.
        place: of the person in the frame of the camera, metres.
    """
    table = MhrTable()
    world, places = [], []
    for joint, (name, parent) in enumerate(zip(table.names, table.parents, strict=True)):
        rest = table.rest[joint] if parent < 0 else table.rest[parent].T @ table.rest[joint]
        local = (turns or {}).get(name, Rotation.identity()).as_matrix()
        kind = name.split("_", 1)[1] if name[0] in "lr" and name[1] == "_" else name
        above = table.names[parent].split("_", 1)[-1] if parent >= 0 else ""
        sign = -1.0 if name.startswith("r_") else 1.0
        if above in _ALONG and kind not in ("upleg", "uparm"):
            offset = np.array([sign * _ALONG[above], 0, 0])
        else:
            offset = np.array(_OFFSETS.get(kind, (0, 0.1, 0) if name.startswith("c_") else (0, 0, 0))) * [sign, 1, 1]
            offset = offset if parent < 0 else table.rest[parent].T @ offset
        world.append(rest @ local if parent < 0 else world[parent] @ rest @ local)
        places.append(offset if parent < 0 else places[parent] + world[parent] @ offset)
    rotations = np.tile(np.eye(3), (MHR_JOINTS, 1, 1))
    joints = np.zeros((MHR_JOINTS, 3))
    rotations[table.numbers], joints[table.numbers] = world, places
    one = {
        "pred_global_rots": rotations,
        "pred_joint_coords": joints * [1, -1, -1],
        "pred_cam_t": np.array(place),
        "pred_keypoints_3d": np.zeros((70, 3)),
    }
    return {key: np.tile(value, (frames, *[1] * value.ndim)).astype(np.float32) for key, value in one.items()}
