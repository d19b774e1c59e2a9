"""Plans and runs that were never trained: files as the commands write them, with numbers made up."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from snarfcli.files import write_json
from snarfcli.reproduce.experiments import EXPERIMENTS
from snarfcli.reproduce.jobs import STATUS, JobStatus
from snarfcli.reproduce.planning import make_plan
from snarfcli.reproduce.plans import ExperimentOptions, Job, Plan

FAKE_MACHINE = {"processor": "a processor", "cores": 2, "threads": 1, "system": "Linux"}
"""Machine of all made-up runs."""


def fake_settings(overrides: Sequence[str]) -> dict[str, Any]:
    """Stand for the configuration of a training without composing it: what differs in the overrides differs in it."""
    return {"data": {"name": "builtin"}, "training": {"name": "quick", "steps": 100}, "overrides": list(overrides)}


def fake_samples(root: Path, subject: str, data: str = "builtin", **frames: int) -> None:
    """Write the manifest by which samples count as made."""
    write_json(root / "processed" / data / subject / "manifest.json", {"frames": {"train": 9, "test": 3, "ood": 2} | frames})


def fake_plan(root: Path, what: str = "table1", **choice: Any) -> Plan:
    """Return a plan whose samples are there; `root` gets data/ and outputs/."""
    choice = {"subjects": ("50002",), "data_root": str(root / "data"), "output_root": str(root / "outputs")} | choice
    for subject in choice["subjects"]:
        fake_samples(root / "data", subject)
    return make_plan(EXPERIMENTS[what], ExperimentOptions(**choice), fake_settings)


def fake_run(
    job: Job,
    values: Mapping[str, float],
    state: str = "done",
    reason: str = "",
    *,
    trained: bool = True,
    spent_s: Mapping[str, float] | None = None,
    **facts: Any,
) -> None:
    """Write what a run leaves behind.

    Args:
        job: the run.
        values: surface IoU `id` and `ood`, and `step_s`, the seconds of each of 100 steps.
        state: its state.
        reason: reason of a failure.
        trained: whether it has an avatar.
        spent_s: duration of its stages in all calls; their processor time is twice as much.
        facts: further content of all its files of metrics, such as `code`.
    """
    folder = Path(job.folder)
    if trained:
        write_json(folder / "metrics.json", {
            "status": "trained", "steps": 100, "timings": {"seconds_per_step": values.get("step_s", 0.6)},
            "machine": FAKE_MACHINE, "versions": {"torch": "2"}, **facts,
        })  # fmt: skip
        (folder / "avatar.pt").write_bytes(b"avatar")
    for evaluation in job.evaluations:
        if evaluation.split in values:
            write_json(Path(evaluation.metrics), fake_metrics(values[evaluation.split], evaluation.settings) | facts)
    stage = "" if state == "done" else "train"
    spent = dict(spent_s or {})
    processor = {name: 2 * seconds for name, seconds in spent.items()}
    write_json(folder / STATUS, asdict(JobStatus(state, job.digest, trained, stage, reason, {}, spent, processor)))


def fake_metrics(surface: float, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of an evaluation's file; the bbox IoU is half way from the surface's to 1."""
    sequences = {name: {"iou_surface": surface, "per_frame": {"frame": [1, 2]}} for name in ("kicks", "splits")}
    return {
        "iou_bbox": (1 + surface) / 2, "iou_surface": surface, "worst_iou_surface": surface - 0.1, "sequences": sequences,
        "timings": {"search_ms_per_200k": 10.0, "shape_ms_per_200k": 20.0, "total_ms_per_200k": 31.0},
        "settings": dict(settings), "machine": FAKE_MACHINE, "versions": {"torch": "2"},
    }  # fmt: skip


def read(path: Path) -> Any:
    """Return the content of a JSON file."""
    return json.loads(path.read_text())
