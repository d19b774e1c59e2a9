"""Seconds to extract the posed surface of one frame, field and skinned, at several resolutions.

    python benchmarks/bm_extraction.py          needs `make demo`, or give --avatar
"""

from __future__ import annotations

from pathlib import Path

import torch
from common import arguments, median_and_spread, print_machine, print_table, require, timed

from snarfcli.models.avatar import Avatar
from snarfcli.motions import builtin_motion


def main() -> None:
    options = arguments(
        "Mesh extraction.",
        avatar={"default": "outputs/builtin/50002/demo/avatar.pt", "help": "a trained avatar"},
        resolutions={"type": int, "nargs": "+", "default": [128, 256], "help": "voxels along the longest side"},
    )
    avatar = Avatar.load(require(Path(options.avatar), "make demo"))
    motion = builtin_motion("jumping_jacks", 0)
    pose = torch.as_tensor(motion.poses[60], dtype=torch.float32)
    print_machine()
    rows = []
    for surface in ("field", "skinned"):
        for resolution in options.resolutions:
            meshes = []
            seconds = timed(
                lambda s=surface, r=resolution, m=meshes: m.append(avatar.mesh(pose, resolution=r, surface=s)), options.repeats
            )
            mesh = meshes[-1]
            points = f"{mesh.stats.points:,}" if mesh.stats else ""
            rows.append([surface, resolution, median_and_spread(seconds), f"{len(mesh.vertices):,}", points])
    print_table(["surface", "resolution", "ms a frame", "vertices", "points evaluated"], rows)


if __name__ == "__main__":
    main()
