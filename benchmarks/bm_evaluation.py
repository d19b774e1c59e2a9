"""Time to evaluate the posed field at 200,000 points of one frame, for each search: search and shape separately.

python benchmarks/bm_evaluation.py          needs `make demo`, or give --avatar and --data-root
"""

from __future__ import annotations

import statistics
from pathlib import Path

import numpy as np
import torch
from common import arguments, median_and_spread, print_machine, print_table, require, timed

from snarfcli.avatar import Avatar
from snarfcli.deformer import SearchConfig
from snarfcli.samples.store import SampleStore

SEARCHES = {
    "complete, cells near the body": SearchConfig("complete"),
    "broyden, 9 start bones": SearchConfig("broyden", init_bones=[0, 1, 2, 4, 5, 16, 17, 18, 19], tolerance=5e-5),
    "broyden, all start bones": SearchConfig("broyden", tolerance=5e-5),
}
POINTS = 200_000


def main() -> None:
    options = arguments(
        "Evaluation of the posed field.",
        avatar={"default": "outputs/builtin/50002/demo/avatar.pt", "help": "a trained avatar"},
        data_root={"default": "data", "help": "folder with the samples"},
    )
    avatar = Avatar.load(require(Path(options.avatar), "make demo"))
    sequence = SampleStore.open(options.data_root, "builtin", "50002").sequences("ood")[0]
    print_machine()
    print(f"{POINTS:,} points of {sequence.name}, half uniform in the papers' cube, half near the surface")
    frame = sequence.num_frames // 2
    generator = np.random.default_rng(0)
    lower, upper = sequence.cube(frame)
    uniform = lower + generator.random((POINTS // 2, 3)) * (upper - lower)
    vertices = sequence.vertices(frame)
    near = vertices[generator.integers(0, len(vertices), POINTS // 2)] + generator.normal(0, 0.01, (POINTS // 2, 3))
    points = torch.as_tensor(np.concatenate([uniform, near]), dtype=torch.float32)[None]
    transforms = torch.as_tensor(sequence.bone_transforms[frame : frame + 1])
    pose = torch.as_tensor(sequence.poses[frame : frame + 1])
    rows = []
    for name, search in SEARCHES.items():
        avatar.model.deformer.search = search
        search_s = timed(lambda: avatar.find(points, transforms, pose), options.repeats)
        roots = avatar.find(points, transforms, pose)
        shape_s = timed(lambda roots=roots: avatar.shape_at(roots, pose), options.repeats)
        seconds = timed(lambda: avatar.query(points, transforms, pose), options.repeats)
        found = avatar.shape_at(roots, pose)
        rows.append([
            name,
            median_and_spread(search_s),
            median_and_spread(shape_s),
            f"{1000 * statistics.median(seconds):.0f}",
            f"{found.correspondences:,}",
            f"{100 * float(found.found.float().mean()):.1f} %",
        ])  # fmt: skip
    print_table(["search", "search, ms", "shape, ms", "total, ms", "correspondences", "points with one"], rows)


if __name__ == "__main__":
    main()
