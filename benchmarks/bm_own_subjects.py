"""Two subjects in files as a user has them, trained and evaluated: a dog as a rigged glTF file, a person as meshes.

    python benchmarks/bm_own_subjects.py FOLDER        samples, avatars and results go there; about 15 minutes on two cores

The dog is made in code (tests/toy_animal.py): it walks, trots and sniffs in training, and sits for testing. The person is
built-in subject 50009, written as one PLY file per frame with a skeleton and poses; jumping jacks are held out.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import trimesh
from common import print_machine, print_table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from toy_animal import ANIMAL_CLIPS, HELD_OUT_CLIP, animal_motion, make_animal
from toy_animal_files import animal_glb

from snarfcli.cli.main import main as snarf
from snarfcli.datasets.builtin import builtin_subject

_PERSON = "50009"
_EVERY = 4  # frames of the person's motions


def write_dog(folder: Path) -> None:
    """Write the dog: one GLB with four animations, and the name of the one that is held out."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "dog.glb").write_bytes(animal_glb(make_animal(), [animal_motion(clip) for clip in ANIMAL_CLIPS]))
    (folder / "split.json").write_text(json.dumps({"test": [HELD_OUT_CLIP]}))


def write_person(folder: Path) -> None:
    """Write the person: a skeleton, and for each sequence its poses and one mesh per frame."""
    subject = builtin_subject(_PERSON)
    skeleton = subject.skeleton
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "names": skeleton.names, "parents": skeleton.parents,
        "joints_rest": skeleton.joints_rest.tolist(), "canonical_pose": skeleton.canonical_pose.tolist(),
    }  # fmt: skip
    (folder / "skeleton.json").write_text(json.dumps(content))
    (folder / "split.json").write_text(json.dumps({"test": [spec.name for spec in subject.of_split("test")]}))
    for spec in (*subject.of_split("train"), *subject.of_split("test")):
        place, motion = folder / spec.name, spec.motion
        place.mkdir(exist_ok=True)
        frames = np.arange(0, motion.num_frames, _EVERY)
        np.savez(
            place / "poses.npz",
            poses=motion.poses[frames],
            trans=motion.translation[frames],
            frame_rate=motion.frame_rate / _EVERY,
        )
        meshes = spec.meshes.chosen(frames)
        for index in range(len(meshes)):
            trimesh.Trimesh(*meshes[index], process=False).export(place / f"frame_{index}.ply")


def main() -> None:
    """Make both subjects, train and evaluate them, and print their IoU."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--training", default="quick", help="preset (default: quick)")
    options = parser.parse_args()
    write_dog(options.folder / "meshes" / "dog")
    write_person(options.folder / "meshes" / "person")
    rows = []
    for subject in ("dog", "person"):
        settings = ["data=meshes", f"subject={subject}", f"data_root={options.folder}"]
        results = f"output_root={options.folder / 'outputs'}"
        steps = (
            ["preprocess", *settings],
            ["train", *settings, results, f"training={options.training}", f"run={options.training}", "resume=true"],
            ["eval", *settings, results, f"run={options.training}", "figure=false"],
        )
        for step in steps:
            if snarf(step) != 0:
                raise SystemExit(f"snarf {' '.join(step)} failed")
        run = options.folder / "outputs" / "meshes" / subject / options.training
        metrics = json.loads((run / "eval_id" / "metrics.json").read_text())
        numbers = [f"{100 * metrics[name]:.2f}" for name in ("iou_bbox", "iou_surface", "worst_iou_surface")]
        rows.append([subject, ", ".join(metrics["sequences"]), str(metrics["frames"]), *numbers])
    print_machine()
    print_table(["subject", "held out", "frames", "IoU bbox, %", "IoU surface, %", "worst frame, %"], rows)


if __name__ == "__main__":
    main()
