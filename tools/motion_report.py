"""Print the range and the speed of every joint in the built-in motions, and in pose files for comparison.

    python tools/motion_report.py [--subject 50002] [file_poses.npz ...]

For each joint the angle to the T-pose (95th percentile and largest, degrees) and the speed (95th percentile, degrees a second),
left and right taken together; then the root mean square speed over all joints of each sequence.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, Motion, builtin_motion, read_motion


def angles_deg(motion: Motion) -> np.ndarray:
    """Return the angle [T, 24] of every joint from its rest pose, degrees."""
    rotations = Rotation.from_rotvec(motion.poses.reshape(-1, 3))
    return np.degrees(rotations.magnitude()).reshape(motion.num_frames, -1)


def speeds_deg_s(motion: Motion) -> np.ndarray:
    """Return the angular speed [T - 1, 24] of every joint, degrees per second."""
    before = Rotation.from_rotvec(motion.poses[:-1].reshape(-1, 3))
    after = Rotation.from_rotvec(motion.poses[1:].reshape(-1, 3))
    turned = (before.inv() * after).magnitude().reshape(motion.num_frames - 1, -1)
    return np.degrees(turned) * motion.frame_rate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", help="AMASS-style pose files")
    parser.add_argument("--subject", type=int, default=50002, help="subject of the built-in motions")
    arguments = parser.parse_args()
    groups = {
        "exercises": [builtin_motion(name, arguments.subject) for name in TRAINING_SEQUENCES],
        "extremes": [builtin_motion(name, arguments.subject) for name in OUT_OF_DISTRIBUTION_SEQUENCES],
    }
    if arguments.files:
        groups["files"] = [read_motion(path) for path in arguments.files]
    print(f"{'angle p95 / max, speed p95':28s}" + "".join(f"{name:>24s}" for name in groups))
    for joint, name in enumerate(SMPL_JOINT_NAMES):
        if name.startswith("r_") or joint == 0:
            continue
        pair = [joint, joint + 1] if name.startswith("l_") else [joint]
        line = f"{name.removeprefix('l_'):28s}"
        for motions in groups.values():
            angle = np.concatenate([angles_deg(motion)[:, pair].ravel() for motion in motions])
            speed = np.concatenate([speeds_deg_s(motion)[:, pair].ravel() for motion in motions])
            line += f"{np.percentile(angle, 95):10.0f} /{angle.max():4.0f}, {np.percentile(speed, 95):5.0f}"
        print(line)
    print("\nroot mean square speed of the joints, degrees a second")
    for group in groups.values():
        for motion in group:
            print(f"  {motion.name:28s}{np.sqrt(np.mean(speeds_deg_s(motion) ** 2)):6.0f}")


if __name__ == "__main__":
    main()
