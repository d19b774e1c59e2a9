"""Time of one training step and its parts, for each preset.

python benchmarks/bm_training.py            needs the samples of `snarf preprocess subject=50002`
"""

from __future__ import annotations

import time
from pathlib import Path

import torch
from common import arguments, median_and_spread, print_machine, print_table, require, timed
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from snarfcli.commands.train import TrainConfig, new_trainer
from snarfcli.hydra_config.schema import config_folder, register_schemas
from snarfcli.precision import matmul_precision
from snarfcli.samples.store import SampleStore
from snarfcli.training.losses import occupancy_loss


def measure(name: str, search: str, store: SampleStore, steps: int, repeats: int) -> list[str]:
    """Return a row: preset, search, and median milliseconds of step, search, shape, and the rest with the backward pass."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config: TrainConfig = OmegaConf.to_object(compose("train", [f"training={name}", f"search={search}"]))
    trainer = new_trainer(config, store, torch.device("cpu"))
    for _ in range(steps):  # so that the weights have left their initial values
        trainer.advance()
    batch = trainer.batches.batch(0)
    parts: dict[str, list[float]] = {"search": [], "shape": []}

    def forward():
        start = time.perf_counter()
        found = trainer.model.find(batch.points, batch.bone_transforms, batch.pose)
        searched = time.perf_counter()
        field = trainer.model.shape_at(found, batch.pose, trainer.config.precision)
        parts["search"].append(searched - start)
        parts["shape"].append(time.perf_counter() - searched)
        return occupancy_loss(field.logits, batch.occupied, field.found)

    def forward_and_backward():
        loss = forward()
        with matmul_precision(trainer.config.precision):
            loss.backward()
        trainer.optimizer.zero_gradients()

    both = timed(forward_and_backward, repeats)
    backward = [whole - a - b for whole, a, b in zip(both, parts["search"][1:], parts["shape"][1:], strict=True)]
    step = timed(trainer.advance, repeats)
    points = f"{batch.points.shape[0]} x {batch.points.shape[1]}"
    search_s, shape_s = (median_and_spread(parts[part][1:]) for part in ("search", "shape"))
    return [name, search, points, search_s, shape_s, median_and_spread(backward), median_and_spread(step)]


def main() -> None:
    options = arguments(
        "Training step.",
        warm_up={"type": int, "default": 60, "help": "steps before the measurement"},
        data_root={"default": "data", "help": "folder with the samples"},
    )
    require(Path(options.data_root) / "processed/builtin/50002/manifest.json", "snarf preprocess subject=50002")
    register_schemas("train", TrainConfig)
    store = SampleStore.open(options.data_root, "builtin", "50002")
    print_machine()
    rows = [
        measure(name, search, store, options.warm_up, options.repeats)
        for name in ("quick", "standard", "paper")
        for search in ("complete", "broyden")
    ]
    header = ["training", "search", "points", "search and weights, ms", "shape, ms", "backward, ms", "whole step, ms"]
    print_table(header, rows)


if __name__ == "__main__":
    main()
