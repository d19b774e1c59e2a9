"""Whole training runs: `quick`, and `paper` eager for some steps, then all its steps as CUDA graphs."""

from __future__ import annotations

from gpu_checks.commands import Run, evaluate_run, iou_loss, train_run
from gpu_checks.context import Context
from snarfcli.errors import UserError
from snarfcli.files import read_json
from snarfcli.texts import one_line

__all__ = ["run_paper", "run_quick"]

_EVAL_S = 35.0  # reserved for the evaluation of a run
_REPORT_S = 5.0  # and after it
_HEADER = ["run", "steps", "command, s", "training, s", "ms per step", "validations, s"]
_IOU_HEADER = ["IoU, %", "bbox in", "surface in", "bbox out", "surface out"]


def run_quick(context: Context) -> None:
    """Train with `training=quick` and compare the IoU with that of the CPU on the same samples."""
    preset = "smoke" if context.tiny else "quick"
    run = train_run(context, "gpu_quick", context.left - _EVAL_S, f"training={preset}", "overwrite=true")
    _report(context, {"quick": run})
    if not run.metrics:
        context.section.goal("quick_seconds", float("nan"), run.ending.status)
        raise UserError(f"snarf train: {run.ending.status}")
    seconds = run.metrics["timings"]["wall_s"]
    context.section.goal("quick_seconds", seconds, f"the whole command: {run.ending.seconds:.1f} s")
    _compare(context, "gpu_quick", "quick")


def run_paper(context: Context) -> None:
    """Train with `training=paper`: some eager steps, then all steps.

    Raises:
        UserError: the time was too short; the stage then is not done, and `--resume` continues the run.
    """
    preset = "smoke" if context.tiny else "paper"
    steps = context.size(300, 20)
    limits = [f"training.steps={steps}", f"training.validate_every={steps}", "training.graph=off"]
    eager = train_run(context, "gpu_paper_eager", context.left / 4, f"training={preset}", *limits, "overwrite=true")
    # on a CPU: the same steps with fixed shapes, but not captured
    anew = "resume=true" if context.resume else "overwrite=true"
    captured = f"training.graph={'auto' if context.device.type == 'cuda' else 'on'}"
    run = train_run(context, "gpu_paper", context.left - _EVAL_S, f"training={preset}", captured, anew)
    _report(context, {"paper, eager": eager, "paper, captured": run})
    if not run.metrics:
        context.section.goal("paper_seconds", float("nan"), f"{run.steps:,} steps in {run.ending.seconds:.0f} s")
        raise UserError(f"snarf train: {run.ending.status} with {run.steps:,} steps so far; --resume continues the run")
    timings = run.metrics["timings"]
    whole = timings["steps_this_run"] == run.steps
    seconds = timings["wall_s"] if whole else timings["seconds_per_step"] * run.steps
    note = f"the whole command: {run.ending.seconds:.1f} s" if whole else "the steps of all parts of an interrupted run"
    context.section.goal("paper_seconds", seconds, note)
    _compare(context, "gpu_paper", "paper")


def _report(context: Context, runs: dict[str, Run]) -> None:
    """Show what runs have measured, and what they remark."""
    context.section.table(_HEADER, [_row(name, run) for name, run in runs.items()])
    for name, run in runs.items():
        for remark in run.remarks:
            context.section.say(f"{name}: `{one_line(remark, 300)}`")


def _row(name: str, run: Run) -> list[str]:
    """Return what a run has measured; the time per step has the first steps in it, with compiling and capturing."""
    if not run.metrics:
        return [name, f"{run.steps:,}", f"{run.ending.seconds:.1f} ({run.ending.status})", "", "", ""]
    timings = run.metrics["timings"]
    step = f"{1000 * timings['seconds_per_step']:.2f}"
    seconds = [f"{run.ending.seconds:.1f}", f"{timings['wall_s']:.1f}", step, f"{timings['validation_seconds']:.1f}"]
    return [name, f"{run.steps:,}", *seconds]


def _compare(context: Context, name: str, preset: str) -> None:
    """Evaluate a run, and compare it with the CPU's numbers in the pack."""
    found = evaluate_run(context, name, max(context.left - _REPORT_S, 10.0))
    wanted = read_json(context.pack / "cpu.json", "numbers of the CPU").get(preset)
    rows = [["GPU", *_shown(found)], *([["CPU", *_shown(wanted)]] if wanted else [])]
    context.section.table(_IOU_HEADER, rows)
    for split, values in found.items():
        for kind, value in values.items():
            context.section.number(f"training/{preset}/{split}/{kind}", value)
    if wanted:
        context.section.goal(f"{preset}_iou", iou_loss(found, wanted), "one seed each")


def _shown(found: dict[str, dict[str, float]]) -> list[str]:
    """Return the cells of one row of IoU."""
    return [
        f"{found[split][kind]:.1f}" if split in found else "-"
        for split in ("id", "ood")
        for kind in ("iou_bbox", "iou_surface")
    ]
