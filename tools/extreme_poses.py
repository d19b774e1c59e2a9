"""Draw the two pictures of extreme poses in the gallery: whole bodies, and hand, shoulder and groin from near.

python tools/extreme_poses.py docs/gallery outputs/builtin/50002/demo outputs/builtin/50004/demo outputs/builtin/50009/demo
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from snarfcli.avatar import Avatar
from snarfcli.evaluation.figure import draw_frame
from snarfcli.meshing import Mesh
from snarfcli.meshing.surfaces import field_surface
from snarfcli.rendering import Camera, contact_sheet, render, write_png
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore

# Per subject, four poses out of distribution: a sequence, and a place in it.
_EXTREMES = (
    (("splits", 0.0), ("bridges", 0.9), ("high_kicks", 0.2), ("deep_squats", 0.4)),
    (("sits_and_twists", 0.8), ("arms_behind_back", 0.8), ("splits", 0.45), ("lunges", 0.3)),
    (("deep_squats", 0.3), ("bridges", 0.6), ("sits_and_twists", 0.6), ("high_kicks", 0.7)),
)
# Joint in the middle of the picture, radius around it in metres, sequence, place in it, azimuth of the camera in degrees.
_NEAR = (
    ("l_hand", 0.16, "high_kicks", 0.2, 60),
    ("r_hand", 0.16, "arms_behind_back", 0.1, 150),
    ("l_shoulder", 0.28, "arms_behind_back", 0.8, 20),
    ("r_shoulder", 0.28, "bridges", 0.9, -60),
    ("pelvis", 0.36, "splits", 0.4, 10),
    ("pelvis", 0.36, "deep_squats", 0.4, 10),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of the pictures extreme_poses.png and close_ups.png")
    parser.add_argument("avatars", nargs="+", help="run folders of one to three subjects; the first is shown from near")
    parser.add_argument("--data-root", default="data", help="folder with the samples")
    parser.add_argument("--resolution", type=int, default=256, help="voxels along the longest side of whole bodies")
    parser.add_argument("--size", type=int, default=240, help="pixels of one picture")
    options = parser.parse_args()
    loaded = [Avatar.load(path) for path in options.avatars]
    stores = [SampleStore.open(options.data_root, avatar.facts["data"], avatar.facts["subject"]) for avatar in loaded]
    rows, labels, captions = [], [], []
    for avatar, store, extremes in zip(loaded, stores, _EXTREMES, strict=False):
        row = []
        for name, place in extremes:
            sequence, index = _frame(store, name, place)
            row += draw_frame(avatar, sequence, index, resolution=options.resolution, size=options.size)[0][:2]
        rows.append(row)
        labels.append(f"subject {avatar.facts['subject']}: ground truth and avatar")
        captions.append([name for name, _ in extremes for _ in range(2)])
    write_png(options.folder / "extreme_poses.png", contact_sheet(rows, row_labels=labels, captions=captions))
    near = [_draw_near(loaded[0], stores[0], *place, 2 * options.resolution, options.size) for place in _NEAR]
    labels = [f"{name}, {joint}" for joint, _, name, _, _ in _NEAR]
    sheet = contact_sheet(list(zip(*near, strict=True)), row_labels=["ground truth", "avatar"], column_labels=labels)
    write_png(options.folder / "close_ups.png", sheet)


def _frame(store: SampleStore, name: str, place: float) -> tuple[SequenceSamples, int]:
    sequence = next(sequence for sequence in store.sequences("ood") if sequence.name == name)
    return sequence, int(place * sequence.num_frames)


def _draw_near(
    avatar: Avatar,
    store: SampleStore,
    joint: str,
    radius: float,
    name: str,
    place: float,
    azimuth_deg: float,
    resolution: int,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return pictures of the ground truth and of the avatar around a joint."""
    sequence, index = _frame(store, name, place)
    true = Mesh(np.array(sequence.vertices(index), np.float32), sequence.faces(index)).with_normals()
    pose, transforms = torch.as_tensor(sequence.poses[index]), torch.as_tensor(sequence.bone_transforms[index])
    learned = field_surface(avatar, pose, resolution=resolution, transforms=transforms)
    middle = sequence.joints[index][store.skeleton.names.index(joint)]
    box = middle + radius * np.array([[-1, -1, -1], [1, 1, 1]])
    camera = Camera.framing(box, azimuth_rad=np.radians(azimuth_deg), margin=0.0)
    floor = float(true.bounds[0][1])
    first, second = (render(mesh, camera, size, floor_y=floor) for mesh in (true, learned))
    return first, second


if __name__ == "__main__":
    main()
