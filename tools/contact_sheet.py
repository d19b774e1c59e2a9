"""Draw ground truth above prediction for frames in and out of distribution: the picture in the README.

python tools/contact_sheet.py outputs/builtin/50002/demo/avatar.pt docs/contact_sheet.png
"""

from __future__ import annotations

import argparse

from snarfcli.avatar import Avatar
from snarfcli.evaluation.figure import draw_frame
from snarfcli.rendering.sheet import contact_sheet, write_png
from snarfcli.samples.store import SampleStore

_FRAMES = {
    "id": [("chicken_wings", 0.2), ("chicken_wings", 0.6)],
    "ood": [("splits", 0.4), ("deep_squats", 0.4), ("high_kicks", 0.15), ("high_kicks", 0.65), ("sits_and_twists", 0.4)],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("avatar", help="the avatar.pt of a trained run")
    parser.add_argument("output", help="the .png to write")
    parser.add_argument("--data-root", default="data", help="folder with the samples")
    parser.add_argument("--resolution", type=int, default=256, help="voxels along the longest side")
    parser.add_argument("--size", type=int, default=256, help="pixels of one picture")
    options = parser.parse_args()
    avatar = Avatar.load(options.avatar)
    store = SampleStore.open(options.data_root, avatar.facts["data"], avatar.facts["subject"])
    truths, predictions, labels = [], [], []
    for split, frames in _FRAMES.items():
        for name, at in frames:
            sequence = next(s for s in store.sequences("test" if split == "id" else "ood") if s.name == name)
            index = int(at * sequence.num_frames)
            pictures, _ = draw_frame(avatar, sequence, index, resolution=options.resolution, size=options.size)
            truths.append(pictures[0])
            predictions.append(pictures[1])
            labels.append(f"{'in' if split == 'id' else 'out of'} distribution: {name}")
    sheet = contact_sheet([truths, predictions], row_labels=["ground truth", "prediction"], column_labels=labels)
    write_png(options.output, sheet)


if __name__ == "__main__":
    main()
