"""A pack for gpu_check.py as small as can be: the bending capsule, untrained avatars of it, and two poses."""

from __future__ import annotations

from pathlib import Path

import torch
from gpu_checks.scene_cases import POSES
from skinning_scenes import smooth_weights
from toy_training import avatar_config, new_avatar, toy_store

from snarfcli.files import write_json

__all__ = ["toy_pack"]

SHAPE = (5, 6, 9)


def toy_pack(folder: Path) -> Path:
    """Make the pack in a folder, and return the folder."""
    store = toy_store(folder / "data", frames=4)
    (folder / "avatars").mkdir()
    for name, condition in (("quick", "local"), ("paper", "global")):
        new_avatar(store, avatar_config(capsules=True, condition=condition)).save(folder / "avatars" / f"{name}.pt")
    avatar = new_avatar(store)
    sequence, poses = store.sequences("test")[0], {}
    for number, name in enumerate(POSES):
        pose = torch.from_numpy(sequence.poses[number])
        inside = sequence.points(number)[sequence.occupancies(number)]
        lower, upper = torch.from_numpy(sequence.cube(number)[0]), torch.from_numpy(sequence.cube(number)[1])
        bones = avatar.bone_transforms(pose[None])[0]
        cube = torch.cat([lower, upper[:1] - lower[:1]])
        poses[name] = {"pose": pose, "bones": bones, "surface": torch.from_numpy(inside), "cube": cube}
    scenes = {
        "weights": smooth_weights(SHAPE, store.skeleton.num_joints, dtype=torch.float32),
        "box": torch.stack([avatar.model.grid.lower, avatar.model.grid.upper]),
        "near": torch.ones(*(n - 1 for n in SHAPE), dtype=torch.bool),
        "nine": list(range(store.skeleton.num_joints)),
        "poses": poses,
    }
    torch.save(scenes, folder / "scenes.pt")
    write_json(folder / "cpu.json", {"quick": {split: {"iou_bbox": 90.0, "iou_surface": 80.0} for split in ("id", "ood")}})
    return folder
