"""Turn a rigged file into a trained avatar, and the avatar into a rigged file again.

The rig is a tail of five joints with two motions, made by code. The avatar learns shape and weights from the posed meshes
alone: the weights of the file serve for measuring only. Run it with `python examples/rigged_file.py FOLDER`; a rigged `.glb` of
your own goes the same way, by the commands that are printed.

The packages of the extra `commands` are needed (`pip install '.[commands]'`).
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

JOINTS, LENGTH = 5, 0.36  # of the tail, and metres from joint to joint
RINGS, SIDES = 61, 24
FRAME_RATE, FRAMES = 30, 60
RADIUS = (0.16, 0.05)  # at the first joint and at the tip, metres

Array = NDArray[np.float64]


def surface() -> tuple[Array, NDArray[np.int64]]:
    """Return vertices [V, 3], metres, and faces [F, 3] of a cone with closed ends, along y."""
    share = np.linspace(0, 1, RINGS)
    radius = np.interp(share, (0, 1), RADIUS)
    angle = np.linspace(0, 2 * math.pi, SIDES, endpoint=False)
    height = np.repeat(JOINTS * LENGTH * share, SIDES)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    x, z = ((radius[:, None] * one).ravel() for one in circle)
    ends = np.array([[0.0, 0.0, 0.0], [0.0, JOINTS * LENGTH, 0.0]])
    a = np.arange(SIDES * (RINGS - 1)).reshape(RINGS - 1, SIDES)
    b, c, d = np.roll(a, -1, 1), a + SIDES, np.roll(a, -1, 1) + SIDES
    first, last, count = a[0], a[-1] + SIDES, SIDES * RINGS
    parts = [np.stack([a, c, b], 2).reshape(-1, 3), np.stack([b, c, d], 2).reshape(-1, 3)]
    parts.append(np.stack([first, np.roll(first, -1), np.full(SIDES, count)], 1))
    parts.append(np.stack([np.roll(last, -1), last, np.full(SIDES, count + 1)], 1))
    vertices: Array = np.concatenate([np.stack([x, height, z], 1), ends])
    return vertices, np.concatenate(parts)


def weights(vertices: Array) -> Array:
    """Return the skinning weights [V, J]: each bone fades into the next around their joint."""
    joints = LENGTH * np.arange(JOINTS)
    beyond = 1 / (1 + np.exp(-(vertices[:, 1, None] - joints[1:]) / 0.04))  # share of all bones from each joint on
    reached = np.concatenate([np.ones((len(vertices), 1)), beyond, np.zeros((len(vertices), 1))], 1)
    return reached[:, :-1] - reached[:, 1:]


def motions() -> dict[str, Array]:
    """Return the angles [T, J] of the joints about z in each motion, radians."""
    time = np.arange(FRAMES)[:, None] / FRAME_RATE
    joint = np.arange(JOINTS)
    swing = 0.5 * np.sin(2 * math.pi * (time - 0.15 * joint)) * (joint > 0)
    curl = 0.6 * np.sin(math.pi * time) * (joint > 0)
    return {"curl": curl, "swing": swing}  # the last one by name is held out


def write_rig(path: Path) -> None:
    """Write the tail as a `.glb`: one mesh with a skin, one clip per motion."""
    from snarfcli.export.glb import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GlbBuilder

    vertices, faces = surface()
    order = np.argsort(-weights(vertices), 1)[:, :4]
    builder = GlbBuilder()
    attributes = {
        "POSITION": builder.array(vertices, target=ARRAY_BUFFER, bounds=True),
        "JOINTS_0": builder.array(order, "uint8", target=ARRAY_BUFFER),
        "WEIGHTS_0": builder.array(np.take_along_axis(weights(vertices), order, 1), target=ARRAY_BUFFER),
    }
    indices = builder.array(faces.ravel(), "uint32", target=ELEMENT_ARRAY_BUFFER)
    builder.add("meshes", primitives=[{"attributes": attributes, "indices": indices}])
    for joint in range(JOINTS):
        children = [joint + 1] if joint + 1 < JOINTS else None
        builder.add("nodes", name=f"tail_{joint}", translation=[0, LENGTH if joint else 0, 0], children=children)
    builder.add("nodes", name="tail", mesh=0, skin=0)
    inverse = np.tile(np.eye(4), (JOINTS, 1, 1))
    inverse[:, 1, 3] = -LENGTH * np.arange(JOINTS)
    builder.add("skins", joints=list(range(JOINTS)), inverseBindMatrices=builder.array(inverse))
    builder.root |= {"scene": 0, "scenes": [{"nodes": [0, JOINTS]}]}
    times = builder.array(np.arange(FRAMES) / FRAME_RATE, bounds=True)
    for name, angles in motions().items():
        samplers, channels = [], []
        for joint in range(JOINTS):
            half = angles[:, joint] / 2
            turns = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], 1)
            channels.append({"sampler": joint, "target": {"node": joint, "path": "rotation"}})
            samplers.append({"input": times, "output": builder.array(turns)})
        builder.add("animations", name=name, samplers=samplers, channels=channels)
    builder.write(path)


def commands(folder: Path, steps: int, frame_step: int) -> list[list[str]]:
    """Return the commands from the rig in `folder` to an avatar and a `.glb` of it."""
    data, output = f"data_root={folder / 'data'}", f"output_root={folder / 'outputs'}"
    subject = ["data=meshes", "subject=tail", data]
    used = [f"data.frame_step={frame_step}", f"data.test_frame_step={frame_step}"]
    motion = f"pose=[{folder / 'data/meshes/tail.glb'}]"
    return [
        ["preprocess", *subject, *used, "points_per_frame=4000"],
        ["train", *subject, output, "training=quick", f"training.steps={steps}", "run=tail"],
        ["eval", *subject, output, "run=tail"],
        ["export", *subject, output, "run=tail", motion, "triangles=4000", "resolution=128"],
    ]


def run(folder: Path, steps: int = 300, frame_step: int = 2) -> Path:
    """Write the rig, run the commands and return the exported file."""
    from snarfcli.cli.main import main

    (folder / "data/meshes").mkdir(parents=True, exist_ok=True)
    write_rig(folder / "data/meshes/tail.glb")
    for command in commands(folder, steps, frame_step):
        print("\nsnarf", *command, flush=True)
        if main(command):
            raise SystemExit(f"snarf {command[0]} failed")
    (character,) = (folder / "outputs/meshes/tail/tail").rglob("*.glb")
    return character


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Turn a rigged file into a trained avatar, and back.")
    parser.add_argument("folder", type=Path, help="for data and results; an empty one")
    print("\nrigged file:", run(parser.parse_args().folder))
