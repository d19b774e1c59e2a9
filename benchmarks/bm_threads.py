"""Trainings of one thread each on all cores, against one training that has all threads: steps per second, in turns.

python benchmarks/bm_threads.py            needs the samples of `snarf preprocess subject=50002`; a minute per row
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import cast

import torch
from common import arguments, print_machine, print_table, require
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from snarfcli.commands.train import TrainConfig, new_trainer
from snarfcli.hydra_config.schema import config_folder, register_schemas
from snarfcli.parallel import Worker, count_cores
from snarfcli.reproduce.experiments import EXPERIMENTS
from snarfcli.samples.store import SampleStore


def train(row: str, threads: int, data_root: str, warm_up: int, requests: Iterator[float]) -> Iterator[float]:
    """Train a row of Table 1 in a process of its own: for each request of some seconds, yield the steps per second.

    Args:
        row: key of the row.
        threads: threads of the process.
        data_root: folder with the samples.
        warm_up: steps before the first measurement.
        requests: seconds to measure.
    """
    torch.set_num_threads(threads)
    register_schemas("train", TrainConfig)
    settings = next(one for one in EXPERIMENTS["table1"].rows if one.key == row).settings("quick")
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = cast(TrainConfig, OmegaConf.to_object(compose("train", ["training=quick", *settings])))
    trainer = new_trainer(config, SampleStore.open(data_root, "builtin", "50002"), torch.device("cpu"))
    for _ in range(warm_up):
        trainer.advance()
    yield 0.0  # ready
    for seconds in requests:
        start, steps = time.perf_counter(), 0
        while time.perf_counter() - start < seconds:
            trainer.advance()
            steps += 1
        yield steps / (time.perf_counter() - start)


def measure(row: str, cores: int, data_root: str, warm_up: int, seconds: float, repeats: int) -> list[str]:
    """Return a row: steps per second of the trainings side by side and of the one, their ratio, its smallest and largest."""
    workers = [Worker(train, (row, threads, data_root, warm_up), has_requests=True) for threads in [1] * cores + [cores]]
    try:
        for worker in workers:
            worker.receive()
        together, alone = workers[:-1], workers[-1:]
        rates: tuple[list[float], list[float]] = ([], [])
        for _ in range(repeats):
            for group, of_group in zip((together, alone), rates, strict=True):
                for worker in group:
                    worker.send(seconds)
                of_group.append(sum(worker.receive()[1] for worker in group))
    finally:
        for worker in workers:
            worker.end()
    ratios = [many / one for many, one in zip(*rates, strict=True)]
    spread = f"{median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})"
    return [row, f"{median(rates[0]):.1f}", f"{median(rates[1]):.1f}", spread]


def main() -> None:
    options = arguments(
        "Trainings of one thread against one training of all threads.",
        rows={"nargs": "*", "default": ["pose_onet", "fast_snarf-broyden", "ours-local"], "help": "rows of Table 1"},
        seconds={"type": float, "default": 4.0, "help": "length of each measurement"},
        warm_up={"type": int, "default": 40, "help": "steps before the measurement"},
        data_root={"default": "data", "help": "folder with the samples"},
    )
    require(Path(options.data_root) / "processed/builtin/50002/manifest.json", "snarf preprocess subject=50002")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # for the trainings, as the commands set it
    cores = options.threads or count_cores()
    print_machine()
    rows = [measure(row, cores, options.data_root, options.warm_up, options.seconds, options.repeats) for row in options.rows]
    print_table(["row", f"{cores} x 1 thread, steps/s", f"1 x {cores} threads, steps/s", "ratio"], rows)


if __name__ == "__main__":
    main()
