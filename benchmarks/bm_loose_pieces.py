"""Loose pieces of the posed field: volume that is not connected with the body, in unseen, training and random poses.

    python benchmarks/bm_loose_pieces.py          needs `make demo`, or give --avatars and --data-root

The field is evaluated at every node of a lattice, since an extraction from coarse to fine can miss small pieces. The cells are
those of a surface at this resolution: `--resolution` along the longest side of `Avatar.posed_box`; the lattice also covers the
images of all searched cells, beyond which nothing is occupied, and grows while its border is occupied.

Two occupied nodes are connected if they share a cell (26 neighbours): a piece is then loose only if a full layer of unoccupied
nodes separates it from the body. With 6 neighbours, thin parts that lie diagonally in the lattice, such as fingers, would fall
apart by sampling alone. Pieces less than about one cell away from the body are not found.

The out-of-distribution frames are those of the samples; the random poses are uniform inside the limits of the joints
(`LIMITS_DEG`), for SMPL's skeleton. `--truth` does the same with the meshes of the out-of-distribution frames: what is loose
there is separated by sampling, not by the avatar.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from common import arguments, print_machine, print_table, require
from scipy import ndimage
from torch import Tensor

from snarfcli.avatar import Avatar
from snarfcli.motions.anatomy import LIMITS_DEG, PARENTS, poses_from_angles
from snarfcli.progress import progress
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.sampling.occupancy import occupancies

_CHUNK = 262_144
_LOOSE_PERCENT = 0.1  # a frame with more than this counts as one with loose pieces
_WIDENINGS = 8  # maximum number of times that a lattice grows, each time by a sixteenth of its longest side


@dataclass(frozen=True)
class Pieces:
    """Connected pieces of what is occupied in one frame."""

    frame: str
    """Sequence and frame, or number of the random pose."""
    pieces: int
    """Number of connected pieces."""
    loose_percent: float
    """Volume outside the largest piece, percent of all that is occupied."""
    loose_litres: float
    """The same in litres."""
    occupied_litres: float
    """Volume of all that is occupied, litres."""


def main() -> None:
    options = arguments(
        "Loose pieces of the posed field.",
        avatars={"nargs": "+", "default": ["outputs/builtin/50002/demo/avatar.pt"], "help": "trained avatars"},
        data_root={"default": "data", "help": "folder with the samples of the avatars' subjects"},
        every={"type": int, "default": 1, "help": "out-of-distribution frames: every N-th of each sequence"},
        training={"type": int, "default": 20, "help": "training frames, evenly spaced"},
        random={"type": int, "default": 50, "help": "random poses inside the limits of the joints"},
        seed={"type": int, "default": 0, "help": "of the random poses"},
        resolution={"type": int, "default": 128, "help": "voxels along the longest side"},
        truth={"action": "store_true", "help": "measure the true meshes of the out-of-distribution frames, too"},
        json={"default": None, "help": "file for the results of each frame"},
    )
    print_machine()
    rows, results, stores = [], [], {}
    for path in options.avatars:
        avatar = Avatar.load(require(Path(path), "make demo"))
        data, subject = avatar.facts["data"], avatar.facts["subject"]
        if (data, subject) not in stores:
            stores[data, subject] = SampleStore.open(options.data_root, data, subject)
        store = stores[data, subject]
        sets = {
            "ood": list(_ood_frames(store, options.every)),
            "training": list(_training_frames(store, options.training)),
            "random": list(_random_frames(avatar, options.random, options.seed)),
        }
        for name, frames in sets.items():
            start = time.perf_counter()
            found = [
                _field_pieces(avatar, *frame, options.resolution)
                for frame in progress(frames, desc=f"{path}, {name}", unit="frames")
            ]
            _add(rows, results, str(path), name, found, time.perf_counter() - start)
    for (data, subject), store in stores.items() if options.truth else ():
        start = time.perf_counter()
        frames = [(sequence, frame) for sequence in store.sequences("ood") for frame in _every(sequence, options.every)]
        found = [_true_pieces(*frame, options.resolution) for frame in progress(frames, desc="true meshes", unit="frames")]
        _add(rows, results, f"true meshes of {data} {subject}", "ood", found, time.perf_counter() - start)
    print(f"\nLoose: outside the largest piece, percent of what is occupied; {options.resolution} voxels, 26 neighbours\n")
    header = [
        "avatar",
        "poses",
        "frames",
        f"over {_LOOSE_PERCENT} %",
        "pieces, most",
        "mean, %",
        "largest, % (litres)",
        "in",
        "s",
    ]
    print_table(header, rows)
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n")


# ---------------------------------------------------------------- frames: name, bone transforms [J, 4, 4], pose [J, 3]
Frame = tuple[str, Tensor, Tensor]


def _every(sequence: SequenceSamples, step: int) -> range:
    return range(0, sequence.num_frames, step)


def _ood_frames(store: SampleStore, step: int) -> Iterator[Frame]:
    for sequence in store.sequences("ood"):
        for frame in _every(sequence, step):
            yield _of_samples(sequence, frame)


def _training_frames(store: SampleStore, count: int) -> Iterator[Frame]:
    frames = [(sequence, int(frame)) for sequence in store.sequences("train") for frame in sequence.train_frames]
    for chosen in np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int):
        yield _of_samples(*frames[chosen])


def _of_samples(sequence: SequenceSamples, frame: int) -> Frame:
    transforms, pose = torch.as_tensor(sequence.bone_transforms[frame]), torch.as_tensor(sequence.poses[frame])
    return f"{sequence.name} {sequence.frame_numbers[frame]}", transforms, pose


def _random_frames(avatar: Avatar, count: int, seed: int) -> Iterable[Frame]:
    """Return poses with angles uniform inside their limits; none for a skeleton other than SMPL's."""
    if tuple(avatar.skeleton.parents) != PARENTS:
        return []
    generator = np.random.default_rng(seed)
    angles = {name: generator.uniform(*limits, count) for name, limits in LIMITS_DEG.items()}
    poses = torch.as_tensor(poses_from_angles(angles, count), dtype=torch.float32)
    transforms = avatar.bone_transforms(poses).cpu()
    return [(f"pose {index}", transforms[index], poses[index]) for index in range(count)]


# ---------------------------------------------------------------- pieces
def _field_pieces(avatar: Avatar, name: str, transforms: Tensor, pose: Tensor, resolution: int) -> Pieces:
    """Return the pieces of the posed field of one frame."""

    def inside(points: np.ndarray) -> np.ndarray:
        parts = torch.as_tensor(points).split(_CHUNK)
        logits = [avatar.query(part[None], transforms[None], pose[None]).logits[0].cpu() for part in parts]
        return (torch.cat(logits) > 0).numpy()

    lower, upper = (corner.double().numpy() for corner in avatar.posed_box(transforms))
    spacing = float((upper - lower).max()) / resolution
    deformer = getattr(avatar.model, "deformer", None)
    if deformer is not None:  # points outside the images of the searched cells have no root, so they are unoccupied
        searched = deformer.posed_box(transforms.to(avatar.device), deformer.active_cells)
        lower, upper = np.minimum(lower, searched[0].numpy()), np.maximum(upper, searched[1].numpy())
    return _pieces(name, inside, lower, upper, spacing)


def _true_pieces(sequence: SequenceSamples, frame: int, resolution: int) -> Pieces:
    """Return the pieces of the true mesh of one frame, by winding number."""
    vertices, faces = sequence.vertices(frame), sequence.faces(frame)
    lower, upper = (corner.astype(np.float64) for corner in sequence.box(frame))

    def inside(points: np.ndarray) -> np.ndarray:
        return occupancies(vertices, faces, points)

    name = f"{sequence.name} {sequence.frame_numbers[frame]}"
    return _pieces(name, inside, lower, upper, float((upper - lower).max()) / resolution)


def _pieces(
    name: str, inside: Callable[[np.ndarray], np.ndarray], lower: np.ndarray, upper: np.ndarray, spacing: float
) -> Pieces:
    """Evaluate `inside` at all nodes of a lattice over a box, and label the connected pieces."""
    for _ in range(_WIDENINGS):
        occupied = _on_lattice(inside, lower - spacing, upper + spacing, spacing)
        border = occupied.sum() - occupied[1:-1, 1:-1, 1:-1].sum()
        if border == 0:
            break
        growth = (upper - lower).max() / 16
        lower, upper = lower - growth, upper + growth
    labels, count = ndimage.label(occupied, structure=np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    total = int(sizes.sum())
    loose = total - int(sizes.max(initial=0))
    litres = 1e3 * spacing**3
    return Pieces(name, count, 100 * loose / max(total, 1), loose * litres, total * litres)


def _on_lattice(inside: Callable[[np.ndarray], np.ndarray], lower: np.ndarray, upper: np.ndarray, spacing: float) -> np.ndarray:
    """Return what is occupied at the nodes from `lower` to at least `upper`, bool [X, Y, Z]."""
    shape = np.ceil((upper - lower) / spacing).astype(int) + 1
    axes = [start + spacing * np.arange(count) for start, count in zip(lower, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    return inside(points).reshape(shape)


def _add(rows: list, results: list, avatar: str, poses: str, found: list[Pieces], seconds: float) -> None:
    """Add one row of the table and the same numbers, with those of every frame, to the results."""
    if not found:
        return
    shares = np.array([pieces.loose_percent for pieces in found])
    worst = found[int(shares.argmax())]
    over, most = int((shares > _LOOSE_PERCENT).sum()), max(pieces.pieces for pieces in found)
    largest = f"{worst.loose_percent:.2f} ({worst.loose_litres:.3f})"
    where = worst.frame if worst.loose_percent > 0 else "-"
    rows.append([avatar, poses, len(found), over, most, f"{shares.mean():.3f}", largest, where, f"{seconds:.0f}"])
    results.append({
        "avatar": avatar, "poses": poses, "frames": len(found), "frames_loose": over, "mean_percent": float(shares.mean()),
        "largest_percent": worst.loose_percent, "largest_litres": worst.loose_litres, "largest_in": worst.frame,
        "seconds": seconds, "of_frames": [asdict(pieces) for pieces in found],
    })  # fmt: skip


if __name__ == "__main__":
    main()
