"""Time to draw one frame of a video, and frames per second of a whole video on one process and on several.

python benchmarks/bm_video.py               needs `make demo`, or give --avatar
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from common import arguments, median_and_spread, print_machine, print_table, require, timed

from snarfcli.avatar import Avatar
from snarfcli.motions import builtin_motion
from snarfcli.parallel import count_cores
from snarfcli.rendering import Camera, render, write_video
from snarfcli.rendering.animation import Animation
from snarfcli.rendering.floor import Backdrop, Floor
from snarfcli.rendering.lighting import Look, Solid
from snarfcli.rendering.panels import Screen
from snarfcli.rendering.pictures import make_pictures
from snarfcli.rendering.stage import body_points, set_stage
from snarfcli.rendering.views import parse_views


def main() -> None:
    options = arguments(
        "Rendering and video.",
        avatar={"default": "outputs/builtin/50002/demo/avatar.pt", "help": "a trained avatar"},
        size={"type": int, "default": 512, "help": "pixels each way"},
        resolution={"type": int, "default": 256, "help": "voxels along the longest side of the skinned surface"},
        frames={"type": int, "default": 100, "help": "frames of the whole video"},
    )
    avatar = Avatar.load(require(Path(options.avatar), "make demo"))
    motion = builtin_motion("jumping_jacks", 0).slice(stop=options.frames)
    print_machine()
    _pictures(options, avatar, motion)
    print()
    _videos(options, avatar, motion)


def _pictures(options, avatar, motion) -> None:
    """Print the time of one picture on one thread."""
    pose, shift = (torch.from_numpy(values[len(values) // 2]).float() for values in (motion.poses, motion.translation))
    mesh = avatar.skinned_surface(options.resolution).posed(pose, shift)
    size, look = (options.size, options.size), Look()
    camera = Camera.framing(mesh.vertices)
    still = Backdrop(camera, size, Floor(float(mesh.vertices[:, 1].min())), look)
    solid = Solid(mesh)
    cases = {
        "all anew": lambda: render(mesh, camera, size),
        "camera stands still": lambda: render(mesh, camera, size, backdrop=still),
        "another view of the same mesh": lambda: render(solid, camera, size, backdrop=still),
        "floor with lines": lambda: Backdrop(camera, size, Floor(0.0, 0.5), look),
        "all anew, 12 rays to the sky": lambda: render(mesh, camera, size, look=Look(sky_rays=12)),
    }
    seconds = {name: timed(work, options.repeats) for name, work in cases.items()}
    whole = np.median(seconds["all anew"])
    rows = [[name, median_and_spread(took), f"{np.median(took) / whole:.2f}"] for name, took in seconds.items()]
    print(f"{len(mesh.vertices):,} vertices, {options.size} x {options.size} pixels")
    print_table(["picture", "ms", "ratio"], rows)


def _videos(options, avatar, motion) -> None:
    """Print the time of a video: skinned surface, pictures and encoding, including the start of the processes."""
    mesh = avatar.skinned_surface(options.resolution).mesh
    cores = count_cores()
    rows = []
    for processes in dict.fromkeys((1, cores)):
        points = body_points(avatar, motion.poses, motion.translation, mesh)
        stage = set_stage(points, motion.poses, parse_views(["front"], 28, 9))
        screen = Screen(stage, (options.size, options.size), {"avatar": ""})
        animation = Animation(
            avatar, motion.name, motion.poses, motion.translation, list(range(motion.num_frames)), surface="skinned",
            resolution=options.resolution, folder=Path("."), suffix=None, screen=screen,
        )  # fmt: skip
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            pictures = make_pictures(animation, processes, max(1, cores // processes))
            write_video(Path(folder) / "video.mp4", pictures, motion.frame_rate)
        took = time.perf_counter() - start
        extraction, rendering = (sum(getattr(f, name) for f in animation.frames) for name in ("extraction_s", "rendering_s"))
        rows.append([processes, f"{took:.1f}", f"{len(animation.frames) / took:.1f}", f"{extraction:.1f}", f"{rendering:.1f}"])
    print_table(["processes", f"s for {motion.num_frames} frames", "frames a second", "surface, s", "rendering, s"], rows)


if __name__ == "__main__":
    main()
