"""Frames per second of preprocessing and the share of each part; the time of a batch compared with a training step.

    python benchmarks/bm_data.py            needs the samples of `snarf preprocess subject=50002`

On a machine that is shared, compare the processor time per frame and the ratios.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from common import arguments, median_and_spread, print_machine, print_table, require, timed
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from snarfcli.commands.train import TrainConfig, new_trainer
from snarfcli.datasets.builtin import builtin_subject
from snarfcli.hydra_config.schema import config_folder, register_schemas
from snarfcli.parallel import count_cores, run_in_processes
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.samples.writing import SequenceWriter
from snarfcli.sampling import (
    SamplingSettings,
    check_mesh,
    dequantise,
    frame_generator,
    quantise,
    sample_frame,
    surface_samples,
    winding_numbers,
)
from snarfcli.training.batches import FrameBatches, FreshBatches

SAMPLING = SamplingSettings(points_per_frame=20_000, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
PARTS_OF = 12  # frames whose parts are timed one by one


def processor_s() -> float:
    """Return the processor time of this process and of its finished child processes, seconds."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in used)


def preprocessing(workers: int) -> list[str]:
    """Preprocess two sequences of the built-in subject; return a row: workers, frames and times."""
    subject = builtin_subject("50002")
    names = [spec.name for spec in subject.sequences][:2]
    with tempfile.TemporaryDirectory() as root:
        start, before = time.perf_counter(), processor_s()
        manifest = preprocess_subject(
            subject, root, SAMPLING, {"train": 4, "test": 4, "ood": 4}, workers=workers, sequences=names
        )
        wall, used = time.perf_counter() - start, processor_s() - before
    frames = sum(manifest["frames"].values())
    return [
        str(workers), str(frames), f"{frames / wall:.1f}", f"{1000 * used / frames:.0f}", f"{manifest['bytes'] / frames:.0f}",
    ]  # fmt: skip


def parts() -> Iterator[list[str]]:
    """Yield rows: a part of preprocessing, its processor time per frame, its share. Runs in a separate process."""
    torch.set_num_threads(1)
    spec = builtin_subject("50002").sequences[0]
    frames = np.linspace(0, spec.motion.num_frames - 1, PARTS_OF).round().astype(int)
    meshes = spec.meshes.chosen(frames)
    faces = meshes.faces
    samples = [sample_frame(v, faces, SAMPLING, frame_generator(0, i)) for i, v in enumerate(meshes.vertices)]
    points = [dequantise(each.points, each.cube_lower, each.cube_size) for each in samples]
    generator = np.random.default_rng(0)

    def per_frame(work: Callable[[int], object]) -> float:
        work(0)
        start = time.process_time()
        for index in range(PARTS_OF):
            work(index)
        return (time.process_time() - start) / PARTS_OF

    near = SAMPLING.points_per_frame // 2
    seconds = {
        "posing the body": per_frame(lambda i: spec.meshes.chosen(frames[i : i + 1])),
        "checking the mesh": per_frame(lambda i: check_mesh(meshes.vertices[i], faces)),
        "Poisson disks": per_frame(lambda i: surface_samples(meshes.vertices[i], faces, near, generator)),
        "winding numbers": per_frame(lambda i: winding_numbers(meshes.vertices[i], faces, points[i])),
    }

    def draw(index: int) -> None:
        each = samples[index]
        noisy = generator.random(points[index].shape) + generator.normal(scale=SAMPLING.surface_noise_m, size=(near, 3)).mean()
        dequantise(quantise(noisy, each.cube_lower, each.cube_size), each.cube_lower, each.cube_size)

    seconds["drawing, noise, quantising"] = per_frame(draw)
    with tempfile.TemporaryDirectory() as root:
        writer = SequenceWriter(Path(root) / "sequence", PARTS_OF, SAMPLING.points_per_frame)

        def write(index: int) -> None:
            writer.write_frame(index, samples[index])
            if index == PARTS_OF - 1:
                writer.finish({}, {"settings": {}})

        seconds["writing, checksums"] = per_frame(write)
    total = sum(seconds.values())
    yield from ([name, f"{1000 * value:.1f}", f"{100 * value / total:.0f} %"] for name, value in seconds.items())


def batches(name: str, store: SampleStore, repeats: int) -> list[str]:
    """Return a row: preset, its step, a stored and a fresh batch, and the batches as shares of the step."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config: TrainConfig = OmegaConf.to_object(compose("train", [f"training={name}", "training.workers=0"]))
    device = torch.device("cpu")
    trainer = new_trainer(config, store, device)
    for _ in range(30):  # so that the weights have left their initial values
        trainer.advance()
    stored, fresh = (kind(store, config.training, 0, device) for kind in (FrameBatches, FreshBatches))
    for step in range(200):  # page cache warm
        stored.batch(step)
    numbers = iter(range(10**9))
    of_step = timed(trainer.advance, repeats)
    of_stored = timed(lambda: stored.batch(next(numbers)), 10 * repeats)
    of_fresh = timed(lambda: fresh.batch(next(numbers)), repeats)
    shares = [100 * np.median(seconds) / np.median(of_step) for seconds in (of_stored, of_fresh)]
    times = [median_and_spread(seconds) for seconds in (of_step, of_stored, of_fresh)]
    shape = f"{config.training.poses_per_step} x {config.training.uniform_points + config.training.surface_points}"
    return [name, shape, *times, *(f"{share:.1f} %" for share in shares)]


def opening(root: str, repeats: int) -> None:
    store = SampleStore.open(root, "builtin", "50002")
    seconds = timed(lambda: SampleStore.open(root, "builtin", "50002"), repeats)
    count = len(store.manifest["sequences"])
    print(f"opening the store of {count} sequences: {median_and_spread(seconds)} ms")


def main() -> None:
    options = arguments("Data.", data_root={"default": "data", "help": "folder with the samples"})
    require(Path(options.data_root) / "processed/builtin/50002/manifest.json", "snarf preprocess subject=50002")
    print_machine()
    if hasattr(os, "getloadavg"):
        print(f"load average of the last minute: {os.getloadavg()[0]:.1f}")
    print("\nPreprocessing, 20,000 points per frame, 6,890 vertices")
    rows = [preprocessing(workers) for workers in dict.fromkeys((1, 2, count_cores()))]
    print_table(["processes", "frames", "frames/s", "processor ms per frame", "bytes per frame"], rows)
    print("\nIts parts, one process")
    print_table(["part", "processor ms per frame", "share"], [row for _, row in run_in_processes(parts, [()], 1)])
    print("\nBatches, made in the training process")
    register_schemas("train", TrainConfig)
    store = SampleStore.open(options.data_root, "builtin", "50002")
    rows = [batches(name, store, options.repeats) for name in ("quick", "standard")]
    header = ["training", "points", "step, ms", "stored batch, ms", "fresh batch, ms", "stored of a step", "fresh of a step"]
    print_table(header, rows)
    opening(options.data_root, options.repeats)


if __name__ == "__main__":
    main()
