"""Training compared with an earlier version of snarf: both in turn, in one run, on the same samples.

    python benchmarks/bm_before.py --before ../snarf-before/.venv/bin/python

The other version has an environment of its own, in its own clone (`git clone . ../snarf-before`, `git checkout COMMIT`,
`make setup`). Needs the samples of `snarf preprocess subject=50002`. `--instruction-set avx2` keeps snarf, PyTorch, oneDNN and
MKL of both versions from using AVX-512.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import arguments, print_machine, print_table, require

# Runs in either version: times steps of one preset after some that refresh the searched cells.
STEPS = """
import json, sys, time
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from pathlib import Path
import snarfcli
from snarfcli.commands.train import TrainConfig, new_trainer
try:
    from snarfcli.hydra_config.schema import register_schemas
except ImportError:
    from snarfcli.cli import register_schemas
try:
    from snarfcli.samples.store import SampleStore
except ImportError:
    from snarfcli.datasets.store import SampleStore
preset, data_root, warm_up, count = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
register_schemas("train", TrainConfig)
with initialize_config_dir(str(Path(snarfcli.__file__).parents[1] / "conf"), version_base="1.3"):
    config = OmegaConf.to_object(compose("train", [f"training={preset}", "subject='50002'"]))
torch.set_num_threads(2)
torch.manual_seed(0)
trainer = new_trainer(config, SampleStore.open(data_root, "builtin", "50002"), torch.device("cpu"))
for _ in range(warm_up):
    trainer.advance()
times, work = [], []
for _ in range(count):
    wall, processor = time.perf_counter(), time.process_time()
    trainer.advance()
    times.append(time.perf_counter() - wall)
    work.append(time.process_time() - processor)
import resource
print(json.dumps({"wall": times, "work": work, "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}))
"""

ENVIRONMENTS = {
    "best": {},
    "avx2": {
        "SNARF_INSTRUCTION_SET": "avx2",
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    },
}


def run(command: list[str], environment: dict[str, str]) -> str:
    """Return what a command prints; it runs outside of any clone, whose package would be imported instead of its own."""
    elsewhere = Path(command[0]).resolve().parent
    found = subprocess.run(command, env=os.environ | environment, cwd=elsewhere, capture_output=True, text=True, check=False)
    if found.returncode:
        raise SystemExit(f"{' '.join(command[:4])} failed:\n{found.stderr[-2000:]}")
    return found.stdout


def time_steps(python: str, preset: str, root: str, counts: tuple[int, int], environment: dict[str, str]) -> dict:
    """Return the times of steps in the version that `python` has, and its peak memory in kilobytes."""
    command = [python, "-c", STEPS, preset, root, *map(str, counts)]
    return json.loads(run(command, environment).splitlines()[-1])


def train(python: str, root: str, seed: int, environment: dict[str, str], folder: str) -> list[str]:
    """Train with `training=quick`; return the seconds from the command to avatar.pt, and IoU in and out of distribution."""
    common = ["subject=50002", f"data_root={root}", f"output_root={folder}", "run=before"]
    start = time.perf_counter()
    command = [python, "-m", "snarfcli", "train", "training=quick", f"seed={seed}", "overwrite=true", "threads=2", *common]
    run(command, environment)
    row = [f"{time.perf_counter() - start:.0f} s"]
    for split in ("id", "ood"):
        command = [python, "-m", "snarfcli", "eval", f"split={split}", "figure=false", *common]
        run(command, environment)
        metrics = json.loads((Path(folder) / "builtin/50002/before" / f"eval_{split}/metrics.json").read_text())
        row.append(f"{100 * metrics['iou_bbox']:.1f} / {100 * metrics['iou_surface']:.1f}")
    return row


def main() -> None:
    options = arguments(
        "Training before and after.",
        before={"required": True, "help": "Python of the other version's environment"},
        data_root={"default": "data", "help": "folder with the samples"},
        instruction_set={"default": "best", "choices": list(ENVIRONMENTS), "help": "largest instruction set in use"},
        rounds={"type": int, "default": 3, "help": "how often both versions are measured"},
        train={"type": int, "default": 0, "help": "number of seeds to train to the end with training=quick"},
    )
    root = str(Path(options.data_root).resolve())
    require(Path(root) / "processed/builtin/50002/manifest.json", "snarf preprocess subject=50002")
    print_machine()
    environment = ENVIRONMENTS[options.instruction_set] | {"OMP_WAIT_POLICY": "PASSIVE"}
    versions = {"before": str(Path(options.before).absolute()), "now": sys.executable}
    rows = []
    for preset, counts in (("quick", (260, 80)), ("paper", (3, 6))):
        runs: dict[str, list[dict]] = {name: [] for name in versions}
        for _ in range(options.rounds):
            for name, python in versions.items():
                runs[name].append(time_steps(python, preset, root, counts, environment))
        medians = {name: [1e3 * statistics.median(run["wall"]) for run in found] for name, found in runs.items()}
        work = {name: statistics.median(1e3 * statistics.median(run["work"]) for run in found) for name, found in runs.items()}
        memory = {name: max(run["memory"] for run in found) / 1024 for name, found in runs.items()}
        ratios = sorted(a / b for a, b in zip(*medians.values(), strict=True))
        rows.append(
            [
                preset,
                *(f"{statistics.median(found):.1f} ms" for found in medians.values()),
                f"{statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})",
                *(f"{value:.0f} ms" for value in work.values()),
                *(f"{value:.0f} MiB" for value in memory.values()),
            ]
        )
    header = ["training", "step before", "step now", "ratio", "processor before", "now", "memory before", "now"]
    print_table(header, rows)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.train):
            for name, python in versions.items():
                rows.append([name, str(seed), *train(python, root, seed, environment, folder)])
    if rows:
        print_table(["version", "seed", "command to avatar.pt", "IoU bbox / surface in", "out"], rows)


if __name__ == "__main__":
    main()
