"""The stages of gpu_check.py, run on the CPU with little work, and the options of the command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import gpu_check
import pytest
import torch
from cuda_emulation import host_compiler
from gpu_checks import commands, stage_training
from gpu_checks.context import Context
from gpu_checks.report import Section
from gpu_checks.runner import Ending
from gpu_checks.stage_list import STAGES, stage_function
from gpu_checks.tools import COUNTERS, counter_rows, kernel_names, sanitizer_findings
from toy_pack import toy_pack

from snarfcli.errors import UserError
from snarfcli.files import write_json, write_tensors
from snarfcli.native.cuda_compile import cuda_sources
from snarfcli.native.library import native_library

pytestmark = pytest.mark.skipif(
    host_compiler() is None or native_library() is None, reason="needs a C++ compiler and the native library"
)
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    return toy_pack(tmp_path_factory.mktemp("pack"))


@pytest.fixture
def context(pack, tmp_path):
    return Context(torch.device("cpu"), True, pack, tmp_path / "work", Section(tmp_path / "section.json"), 60.0)


@pytest.mark.parametrize(
    ("stage", "goals"),
    [
        ("correct", set()),
        ("search", {"search_near", "search_worst"}),
        ("gradient", set()),
        ("field", {"query"}),
        ("meshes", {"meshes"}),
        ("memory", set()),
    ],
)
def test_stages_that_measure_run_on_a_cpu_too(context, stage, goals):
    stage_function(stage)(context)
    content = json.loads(context.section.path.read_text())
    tables = [part for part in content["parts"] if "rows" in part]
    assert tables
    for table in tables:
        assert all(len(row) == len(table["header"]) for row in table["rows"])
        assert not any("failed" in cell for row in table["rows"] for cell in row)
    assert set(content["goals"]) == goals
    assert all(goal["value"] is not None for goal in content["goals"].values())


def test_the_gpu_stage_compares_with_the_cpu(context):
    stage_function("correct")(context)
    (table,) = [part for part in context.section.content["parts"] if "rows" in part]
    for row in table["rows"]:
        named = dict(zip(table["header"], row, strict=True))
        assert int(named["roots"].replace(",", "")) > 100
        assert named["queries with another number of roots"] == "0"
        assert named["same bits again"] == "True"


# ---------------------------------------------------------------- training
def finished_run(folder: Path, steps: int, steps_this_run: int) -> None:
    timings = {"wall_s": 45.0, "steps_this_run": steps_this_run, "seconds_per_step": 0.002, "validation_seconds": 1.5}
    write_json(folder / "metrics.json", {"timings": timings})
    write_tensors(folder / "checkpoint.pt", {"step": steps})


@pytest.mark.parametrize(("this_run", "seconds"), [(45_000, 45.0), (5_000, 90.0)])
def test_a_run_in_parts_counts_all_its_steps(context, monkeypatch, this_run, seconds):
    folder = context.work / "runs" / "builtin" / "toy" / "gpu_paper"
    finished_run(folder, 45_000, this_run)
    iou = {"id": {"iou_bbox": 90.0, "iou_surface": 80.2}, "ood": {"iou_bbox": 89.0, "iou_surface": 79.0}}
    monkeypatch.setattr(stage_training, "train_run", lambda context, *rest: commands.Run(folder, Ending("done", 50.0)))
    monkeypatch.setattr(stage_training, "evaluate_run", lambda *rest: iou)
    stage_training.run_paper(context)
    assert context.section.content["goals"]["paper_seconds"]["value"] == seconds
    stage_training._compare(context, "gpu_quick", "quick")
    assert context.section.content["goals"]["quick_iou"]["value"] == pytest.approx(1.0)


def test_a_run_that_was_stopped_is_no_success(context, monkeypatch):
    folder = context.work / "runs" / "builtin" / "toy" / "gpu_paper"
    write_tensors(folder / "checkpoint.pt", {"step": 12_000})
    stopped = commands.Run(folder, Ending("stopped at its time limit", 50.0))
    monkeypatch.setattr(stage_training, "train_run", lambda context, *rest: stopped)
    with pytest.raises(UserError, match="stopped at its time limit with 12,000 steps so far; --resume continues the run"):
        stage_training.run_paper(context)
    goal = context.section.content["goals"]["paper_seconds"]
    assert goal["value"] is None
    assert goal["note"] == "12,000 steps in 50 s"


def test_iou_of_one_split_alone_is_not_judged():
    both = {split: {"iou_bbox": 90.0, "iou_surface": 80.0} for split in ("id", "ood")}
    assert commands.iou_loss({"id": both["id"]}, both) != commands.iou_loss({"id": both["id"]}, both)
    better = {split: {"iou_bbox": 91.0, "iou_surface": 82.0} for split in ("id", "ood")}
    assert commands.iou_loss(better, both) == -2.0


# ---------------------------------------------------------------- tools
SANITIZER = """========= COMPUTE-SANITIZER
========= Invalid __global__ write of size 4 bytes
=========     at search_tame+0x1a0
=========     by thread (3,0,0) in block (0,0,0)
=========     Address 0x7f0b000200 is out of bounds
=========     and is 1 bytes after the nearest allocation at 0x7f0b000000 of size 512 bytes
========= Invalid __global__ read of size 4 bytes
=========     at 0x210 in write_roots
=========     Saved host backtrace up to driver entry point at kernel launch time
========= Uninitialized __global__ memory read of size 4 bytes
=========     at void at::native::copy<float>(float *, int)+0x40 in copy.cu:10
========= ERROR SUMMARY: 3 errors
"""


def test_errors_of_the_sanitizers_are_counted_by_kernel():
    errors, kernels = sanitizer_findings(SANITIZER)
    assert errors == 3
    assert kernels["search_tame"] == kernels["write_roots"] == 1
    assert not any("0x" in name for name in kernels)
    assert sanitizer_findings("========= RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)\n") == (0, {})
    assert sanitizer_findings("========= Error: Target application terminated before first instrumented API call\n")[0] is None


def test_counters_are_read_from_the_output_of_ncu():
    header = ['"ID"', '"Kernel Name"', *(f'"{name}"' for name in COUNTERS)]
    units = ['""', '""', '"nsecond"', *['"%"'] * 4, '""', '"register/thread"']
    values = ['"0"', '"search_tame(Search<float>)"', '"12,500"', '"61.234"', '"n/a"', '"10"', '"40.5"', '"30.1"', '"128"']
    output = "==PROF== Connected\n4711 roots\n" + "\n".join(",".join(line) for line in (header, units, values))
    assert counter_rows(output) == [["search_tame", "12.5", "61.23", "-", "10", "40.5", "30.1", "128"]]
    assert counter_rows("==ERROR== no permission\n") == []


def test_kernels_are_found_in_the_sources():
    names = kernel_names(cuda_sources() / "cuda" / "gather.cu")
    assert {"collect_roots", "write_roots"} <= set(names)


# ---------------------------------------------------------------- the command
def test_stages_are_chosen_by_name():
    assert gpu_check.choose_stages(None, None) == list(STAGES)
    assert [stage.name for stage in gpu_check.choose_stages("search,paper", "paper")] == ["search"]
    with pytest.raises(UserError, match="no stage 'serach'; choose from machine, "):
        gpu_check.choose_stages("serach", None)
    with pytest.raises(UserError, match="no stage is left"):
        gpu_check.choose_stages("search", "search")


def test_what_is_missing_is_said_in_one_line(pack, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for given, wanted in (
        (["--pack", str(pack)], "CUDA is not available: "),
        (["--look"], "CUDA is not available: "),
        (["--dry-run", "--pack", str(tmp_path)], "has no scenes.pt; make it with: python benchmarks/pack_gpu_check.py"),
        (["--dry-run", "--pack", str(pack), "--minutes", "0"], "--minutes: wanted more than 0"),
    ):
        monkeypatch.setattr(sys, "argv", ["gpu_check.py", *given])
        assert gpu_check.main() == 2
        error = capsys.readouterr().err
        assert wanted in error
        assert error.count("\n") == 1


def test_a_dry_run_writes_a_report_that_says_what_it_is(pack, tmp_path, monkeypatch, capsys):
    given = [
        "gpu_check.py",
        "--dry-run",
        "--pack",
        pack,
        "--work",
        tmp_path / "work",
        "--only",
        "gradient,search",
        "--minutes",
        "2",
    ]
    monkeypatch.setattr(sys, "argv", [str(value) for value in given])
    assert gpu_check.main() == 0
    report = (tmp_path / "work" / "dry_run" / "gpu-dry-run.md").read_text()
    assert report.startswith("# Dry run on a CPU")
    assert "released, as called" in report
    assert "**missed**" not in report
    assert "reached" not in report
    assert "search: done" in capsys.readouterr().out


def test_the_marker_selects_no_emulated_test():
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-m", "gpu", "tests/native/test_cuda.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    chosen = [line for line in done.stdout.splitlines() if "::" in line]
    assert "tests/native/test_cuda.py::test_the_current_stream_and_device_are_used" in chosen
    assert not any("emulated" in line for line in chosen)
