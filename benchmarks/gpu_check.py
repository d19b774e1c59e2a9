"""Check and measure everything that runs on a GPU, in at most nine minutes.

    python benchmarks/pack_gpu_check.py        with all packages: samples, avatars and scenes into outputs/gpu_check
    python benchmarks/gpu_check.py             there or on another machine: all stages
    python benchmarks/gpu_check.py --resume    only those that are not done; an interrupted training run continues
    python benchmarks/gpu_check.py --dry-run   without a GPU: the code of all stages on little work, with the same folder

Each stage (gpu_checks/) is a process with a time limit: one that fails or takes too long is reported, and the next one runs.
The report, benchmarks/results/gpu-<name>.md, is written after each stage, and the raw numbers beside it as JSON.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for a checkout that is not installed

from gpu_checks.runner import Results, Stage, python_command, run_stages
from gpu_checks.stage_list import STAGES, stage_function

from snarfcli.errors import UserError
from snarfcli.native import cuda
from snarfcli.texts import terminal_text

ROOT = Path(__file__).resolve().parents[1]
MARGIN_S = 10.0  # for the start of this process and the last report
PACKED = ("scenes.pt", "cpu.json", "avatars/quick.pt", "avatars/paper.pt", "data")


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pack", type=Path, default=ROOT / "outputs" / "gpu_check", help="folder made by pack_gpu_check.py")
    parser.add_argument("--work", type=Path, default=ROOT / "outputs" / "gpu_check_work", help="folder for runs and logs")
    parser.add_argument("--out", type=Path, help="the report, a Markdown file (default: in benchmarks/results)")
    parser.add_argument("--look", action="store_true", help="only look for a GPU: exit code 2 and a line if there is none")
    parser.add_argument("--only", help=f"comma-separated stages: {', '.join(stage.name for stage in STAGES)}")
    parser.add_argument("--skip", help="comma-separated stages to leave out")
    parser.add_argument("--minutes", type=float, default=9.0, help="for all stages together")
    parser.add_argument("--resume", action="store_true", help="keep the stages that are done in an earlier report")
    parser.add_argument("--dry-run", action="store_true", help="on the CPU, with little work; the numbers mean nothing")
    parser.add_argument("--stage", help=argparse.SUPPRESS)  # what this program calls itself with
    parser.add_argument("--section", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def choose_stages(only: str | None, skip: str | None) -> list[Stage]:
    """Return the stages of the options --only and --skip.

    Raises:
        UserError: there is no such stage, or none is left.
    """
    known = [stage.name for stage in STAGES]
    wanted, unwanted = (text.split(",") if text else [] for text in (only, skip))
    for name in (*wanted, *unwanted):
        if name not in known:
            raise UserError(f"no stage {name!r}; choose from {', '.join(known)}")
    chosen = [stage for stage in STAGES if (not wanted or stage.name in wanted) and stage.name not in unwanted]
    if not chosen:
        raise UserError("no stage is left; give fewer with --skip, or others with --only")
    return chosen


def require_gpu() -> None:
    """Raise UserError if there is no GPU."""
    if not torch.cuda.is_available():
        raise UserError(f"CUDA is {cuda.cuda_status()}; --dry-run runs the code of all stages on the CPU")


def check_place(options: argparse.Namespace) -> None:
    """Raise UserError if there is no GPU, no pack or no time."""
    if not options.dry_run:
        require_gpu()
    missing = [name for name in PACKED if not (options.pack / name).exists()]
    if missing:
        raise UserError(f"{options.pack} has no {missing[0]}; make it with: python benchmarks/pack_gpu_check.py")
    if not options.minutes > 0:
        raise UserError(f"--minutes: wanted more than 0, got {options.minutes:g}")


def run_stage(options: argparse.Namespace) -> None:
    """Run one stage in this process."""
    from gpu_checks.context import Context
    from gpu_checks.report import Section

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what it has started is ended too
    device = torch.device("cpu") if options.dry_run else torch.device("cuda", torch.cuda.current_device())
    section = Section(options.section)
    places = (options.pack, options.work, section)
    stage_function(options.stage)(Context(device, options.dry_run, *places, options.seconds, options.resume))


def check(options: argparse.Namespace) -> bool:
    """Run all chosen stages; return whether all are done."""
    chosen = choose_stages(options.only, options.skip)
    check_place(options)
    name = "Dry run on a CPU, whose numbers mean nothing" if options.dry_run else torch.cuda.get_device_name()
    pack, work = options.pack.resolve(), options.work.resolve() / ("dry_run" if options.dry_run else "")
    folder = work if options.dry_run else ROOT / "benchmarks" / "results"
    out = options.out or folder / f"gpu-{'dry-run' if options.dry_run else '-'.join(name.lower().split())}.md"
    facts = f"`python benchmarks/gpu_check.py`, PyTorch {torch.__version__}. Times are of one run."
    results = Results(out, name, facts, STAGES, is_dry=options.dry_run)
    if options.resume:
        results.load_finished()

    def command(stage: Stage, section: Path, seconds: float) -> list[str]:
        given = ["--stage", stage.name, "--section", section, "--seconds", f"{seconds:.1f}", "--pack", pack, "--work", work]
        flags = [flag for flag, is_set in (("--dry-run", options.dry_run), ("--resume", options.resume)) if is_set]
        return python_command(Path(__file__).resolve(), *given, *flags)

    def say(line: str) -> None:
        print(terminal_text(line), flush=True)

    seconds = 60 * options.minutes - MARGIN_S
    done = run_stages(results, chosen, command, work / "stages", seconds, say)
    say(f"report: {out}\nraw numbers: {results.json_path}")
    return done


def main() -> int:
    options = parse()
    try:
        if options.look:
            require_gpu()
            return 0
        if options.stage:
            run_stage(options)
            return 0
        return 0 if check(options) else 1
    except UserError as error:
        print(f"gpu_check: {terminal_text(str(error))}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
