"""Arrays of made-up pose files, and a skeleton other than SMPL's."""

from __future__ import annotations

import numpy as np
import torch

from snarfcli.bodies import Skeleton

TWO_JOINTS = Skeleton(("a", "b"), (-1, 0), torch.zeros(2, 3), torch.zeros(2, 3))
UPRIGHT_IN_Z_UP = np.array([np.pi / 2, 0, 0])  # turns the y-up rest body to stand along z


def amass_arrays(frames=4, width=156, seed=0):
    rng = np.random.default_rng(seed)
    poses = 0.3 * rng.normal(size=(frames, width))
    poses[:, :3] = UPRIGHT_IN_Z_UP + 0.1 * rng.normal(size=(frames, 3))
    trans = rng.normal(size=(frames, 3))
    return {
        "poses": poses,
        "trans": trans,
        "mocap_framerate": np.array(120.0),
        "gender": np.array("neutral"),
        "betas": np.zeros(16),
    }


def save(tmp_path, **arrays):
    path = tmp_path / "walk_poses.npz"
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path
