"""Stages of gpu_check.py: limits in time, failures, resumption, and the report; and what the tools' output says."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import pytest
import torch
from gpu_checks.goals import GOALS
from gpu_checks.report import Section, table_text
from gpu_checks.runner import Results, Stage, run_limited, run_stages
from gpu_checks.stage_list import STAGES, stage_function
from gpu_checks.timing import Clock, Timing

from snarfcli.errors import UserError

needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
FIRST, SECOND, THIRD = (Stage(name, f"Stage {name}", 30) for name in ("first", "second", "third"))


def results_in(tmp_path: Path) -> Results:
    return Results(tmp_path / "report.md", "A_GPU", "facts", (FIRST, SECOND, THIRD))


def commands(**code: str):
    """Return the function that gives the command of each stage: Python code, with the section's path as its argument."""
    return lambda stage, section, seconds: [sys.executable, "-c", code[stage.name], str(section)]


def section_code(text: str) -> str:
    """Return code that writes a section with one paragraph, as a stage does."""
    content = {"parts": [{"text": text}], "numbers": {"a": 1}, "goals": {}}
    return f"import sys; open(sys.argv[1], 'w').write({json.dumps(content)!r})"


def test_a_stage_that_fails_is_reported_and_the_next_one_runs(tmp_path):
    results, said = results_in(tmp_path), []
    broken = section_code("measured before") + "; print('what \\x1b[31mhappened'); raise SystemExit(3)"
    command = commands(first=broken, second=section_code("all well"))
    assert not run_stages(results, (FIRST, SECOND), command, tmp_path / "stages", 60, said.append)
    report = (tmp_path / "report.md").read_text()
    assert "measured before" in report
    assert "**failed (exit code 3)** after" in report
    assert "what \\x1b[31mhappened" in report  # control characters are visible
    assert report.index("## Stage first") < report.index("## Stage second") < report.index("all well")
    assert "Stage third" not in report
    assert any(line.startswith("first: failed (exit code 3)") for line in said)
    stages = json.loads((tmp_path / "report.json").read_text())["stages"]
    assert [stages[name]["status"] for name in ("first", "second")] == ["failed (exit code 3)", "done"]


def has_ended(pid: str) -> bool:
    """Return whether a process has ended; the system may need a moment for one that was ended."""
    for _ in range(200):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().split(") ")[-1][0]
        except OSError:
            return True
        if state == "Z":  # ended; its parent has not collected the exit code
            return True
        time.sleep(0.05)
    return False


@needs_proc
def test_a_stage_that_takes_too_long_is_ended_with_all_its_processes(tmp_path):
    sleep = "import time; time.sleep(60)"
    child = f"import subprocess, sys; print(subprocess.Popen([sys.executable, '-c', {sleep!r}]).pid, flush=True); "
    ending = run_limited([sys.executable, "-c", child + sleep], 2.0, tmp_path / "log")
    assert ending.status == "stopped at its time limit"
    assert ending.seconds < 30
    assert has_ended((tmp_path / "log").read_text().strip())


def test_a_process_that_is_asked_to_end_may_finish_its_files(tmp_path):
    target = tmp_path / "finished"
    code = (
        "import signal, sys, time, pathlib\n"
        f"def finish(*_): pathlib.Path({str(target)!r}).write_text('whole'); sys.exit(0)\n"
        "signal.signal(signal.SIGTERM, finish)\n"
        "time.sleep(60)\n"
    )
    assert run_limited([sys.executable, "-c", code], 4.0, tmp_path / "log").status == "stopped at its time limit"
    assert target.read_text() == "whole"


@needs_proc
def test_what_a_stage_leaves_running_is_ended(tmp_path):
    code = "import subprocess, sys; print(subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']).pid)"
    ending = run_limited([sys.executable, "-c", code], 20, tmp_path / "log")
    assert ending.status == "done"
    assert has_ended((tmp_path / "log").read_text().strip())


def test_stages_for_which_no_time_is_left_are_not_begun(tmp_path):
    results = results_in(tmp_path)
    assert not run_stages(results, (FIRST,), commands(first="raise SystemExit"), tmp_path / "stages", 5, lambda line: None)
    assert "**not begun: no time was left** after 0 s" in (tmp_path / "report.md").read_text()


def test_resuming_keeps_what_is_done_and_runs_the_rest(tmp_path):
    command = commands(first=section_code("from the first call"), second="raise SystemExit(1)")
    run_stages(results_in(tmp_path), (FIRST, SECOND), command, tmp_path / "stages", 60, lambda line: None)
    again, said = results_in(tmp_path), []
    again.load_finished()
    command = commands(first="raise SystemExit(1)", second=section_code("from the second call"))
    assert run_stages(again, (FIRST, SECOND), command, tmp_path / "stages", 60, said.append)
    report = (tmp_path / "report.md").read_text()
    assert said[0] == "first: done before"
    assert "from the first call" in report
    assert "from the second call" in report
    assert "failed (" not in report


@pytest.mark.parametrize("content", ["[]", '{"stages": 3}', '{"stages": {"first": {}}}'])
def test_resuming_from_another_file_is_a_user_error(tmp_path, content):
    results = results_in(tmp_path)
    with pytest.raises(UserError, match="no earlier report"):
        results.load_finished()
    results.json_path.write_text(content)
    with pytest.raises(UserError, match="is no report of gpu_check"):
        results.load_finished()


# ---------------------------------------------------------------- results and report
def test_goals_are_judged_by_what_was_measured(tmp_path):
    section = Section(tmp_path / "section.json")
    section.goal("search_near", 12.5, "knees | near")
    section.goal("quick_seconds", 10.5)
    section.goal("query", float("nan"), "out of memory")
    section.number("failed/ms", float("nan"))
    results = results_in(tmp_path)
    ending = run_limited([sys.executable, "-c", ""], 20, tmp_path / "log")
    results.add(FIRST, ending, json.loads((tmp_path / "section.json").read_text()), "")
    rows = [line.split(" | ") for line in (tmp_path / "report.md").read_text().splitlines() if line.startswith("| ")]
    verdicts = {row[0].strip("| "): [cell.strip(" |") for cell in row[1:4]] for row in rows}
    assert verdicts[GOALS["search_near"].what] == ["at least 10", "12.5", "reached"]
    assert verdicts[GOALS["quick_seconds"].what] == ["at most 10", "10.5", "**missed**"]
    assert verdicts[GOALS["query"].what] == ["at least 20", "failed", "**missed**"]
    assert verdicts[GOALS["paper_seconds"].what] == ["at most 120", "not run", ""]
    assert "knees \\| near" in (tmp_path / "report.md").read_text()
    assert json.loads((tmp_path / "section.json").read_text())["numbers"] == {"failed/ms": None}


def test_tables_are_aligned():
    text = table_text(["a", "longer"], [["value", "1"]])
    assert text.splitlines() == ["| a     | longer |", "| ----- | ------ |", "| value | 1      |"]


def test_every_stage_has_its_function_and_the_longest_is_last():
    assert all(callable(stage_function(stage.name)) for stage in STAGES)
    assert len({stage.name for stage in STAGES}) == len(STAGES)
    assert max(STAGES, key=lambda stage: stage.seconds) is STAGES[-1]


# ---------------------------------------------------------------- times
def test_works_are_timed_in_turns_and_one_that_fails_does_not_spoil_the_others():
    calls = []

    def fails():
        raise RuntimeError("cannot be\ncaptured")

    clock = Clock(torch.device("cpu"))
    times = clock.in_turns({"a": lambda: calls.append("a"), "b": fails, "c": lambda: calls.append("c")}, 3, ("b",))
    assert calls == ["a", "c"] * 5  # one call each to try, one round to warm up
    assert list(times) == ["a", "b", "c"]
    assert [len(times[name].ms) for name in "abc"] == [3, 0, 3]
    assert str(times["b"]) == "failed: cannot be captured"
    assert times["b"].median != times["b"].median
    assert times["a"].over(times["b"]) == "-"
    assert Timing((2.0, 4.0, 9.0)).over(Timing((2.0,))) == "2.0"
    assert str(Timing((2.0, 4.0, 9.0))) == "4.000 (2.000-9.000)"
