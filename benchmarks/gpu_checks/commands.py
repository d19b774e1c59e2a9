"""Run commands of snarf with a time limit, and read what they measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gpu_checks.context import Context
from gpu_checks.runner import Ending, run_limited
from snarfcli.files import read_json
from snarfcli.safe_start import safe_environment, snarf_command

__all__ = ["Run", "evaluate_run", "iou_loss", "train_run"]

_SPLITS = ("id", "ood")


@dataclass(frozen=True)
class Run:
    """A training run."""

    folder: Path
    ending: Ending
    """Of the command."""
    output: str = ""
    """Of the command."""

    @property
    def remarks(self) -> list[str]:
        """Lines of the output that say that something else ran than was asked for, such as uncaptured steps."""
        return [line for line in self.output.splitlines() if "not captured" in line or "warning" in line.lower()]

    @property
    def metrics(self) -> dict[str, Any]:
        """The content of `metrics.json`; empty if the run has not ended."""
        path = self.folder / "metrics.json"
        return read_json(path, "metrics") if path.exists() else {}

    @property
    def steps(self) -> int:
        """Number of steps in the last checkpoint."""
        path = self.folder / "checkpoint.pt"
        return int(torch.load(path, map_location="cpu", weights_only=True)["step"]) if path.exists() else 0


def train_run(context: Context, name: str, seconds: float, *overrides: str) -> Run:
    """Train on the packed samples with overrides, and show the end of the output if the command fails.

    At its limit the command writes a checkpoint and ends.
    """
    ending, output = _snarf(context, "train", seconds, f"run={name}", *overrides)
    return Run(context.work / "runs" / "builtin" / context.subject / name, ending, output)


def evaluate_run(context: Context, name: str, seconds: float) -> dict[str, dict[str, float]]:
    """Return the IoU, bbox and surface in percent, of a run's avatar by split; of the splits that could be evaluated."""
    found = {}
    for split in _SPLITS:
        ending, _ = _snarf(context, "eval", seconds / len(_SPLITS), f"run={name}", f"split={split}", "figure=false")
        path = context.work / "runs" / "builtin" / context.subject / name / f"eval_{split}" / "metrics.json"
        if ending.status == "done":
            metrics = read_json(path, "metrics")
            found[split] = {kind: 100 * metrics[kind] for kind in ("iou_bbox", "iou_surface")}
    return found


def iou_loss(found: dict[str, dict[str, float]], wanted: dict[str, dict[str, float]]) -> float:
    """Return by how many percentage points the surface IoU is below the wanted one, in the worst split; NaN without one."""
    losses = [wanted[split]["iou_surface"] - found[split]["iou_surface"] for split in _SPLITS if split in found]
    return max(losses) if len(losses) == len(_SPLITS) else float("nan")


def _snarf(context: Context, command: str, seconds: float, *overrides: str) -> tuple[Ending, str]:
    """Run a command on the packed samples and return its output, which is printed too if it fails."""
    log = context.work / f"{command}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    log.write_text("")
    places = [f"data_root={context.pack / 'data'}", f"output_root={context.work / 'runs'}"]
    given = [command, f"subject={context.subject}", *places, f"device={context.device.type}", *overrides]
    ending = run_limited(snarf_command(given), max(seconds, 1.0), log, safe_environment())
    output = log.read_text(errors="replace")
    if ending.status != "done":
        print(f"snarf {' '.join(given)}: {ending.status}", output[-2000:], sep="\n", flush=True)
    return ending, output
