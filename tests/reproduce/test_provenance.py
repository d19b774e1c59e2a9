"""Reports say which version of the code, which machine and how much time their numbers are from."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_runs import FAKE_MACHINE, fake_metrics, fake_plan, fake_run, read

from snarfcli.files import write_json
from snarfcli.reproduce.provenance import code_versions, cost_text, machines
from snarfcli.reproduce.report import write_report
from snarfcli.reproduce.results import collect

VALUES = {"id": 0.9, "ood": 0.8}
OLD, NEW = {"digest": "aaaaaaaaaaaa", "commit": "0123456789"}, {"digest": "bbbbbbbbbbbb", "commit": "abcdef0123-dirty"}


@pytest.fixture
def plan(tmp_path):
    return fake_plan(tmp_path, systems=("nasa", "snarf"), seeds=(0, 1))


def collected(plan):
    return [collect(job) for job in plan.jobs]


def text_of(plan, folder):
    write_report(plan, collected(plan), folder, "snarf reproduce table1")
    return (folder / "table1.md").read_text()


def test_one_version_and_one_machine_are_named_in_the_head(plan, tmp_path):
    for job in plan.jobs:
        fake_run(job, VALUES, code=OLD, spent_s={"samples": 5.0, "train": 600.0, "id": 15.0})
    text = text_of(plan, tmp_path / "report")
    assert "- code: commit 0123456789, files aaaaaaaaaaaa\n" in text
    assert "- machine: a processor, 2 cores, 1 thread per run, Linux, PyTorch 2\n" in text
    assert "- cost: 4 runs: 41 min one after the other and 83 min of processor time, with samples, validations" in text
    assert "## Versions" not in text
    assert "Unfinished" not in text


def test_several_versions_are_listed_with_their_runs(plan, tmp_path):
    first, second, third, fourth = plan.jobs
    fake_run(first, VALUES, code=OLD)
    fake_run(second, VALUES, code=NEW)
    fake_run(third, VALUES)
    fake_run(fourth, VALUES, code=OLD)
    write_json(fourth.evaluations[1].metrics, fake_metrics(0.8, fourth.evaluations[1].settings) | {"code": NEW})
    found = code_versions(collected(plan))
    assert found == {
        "commit 0123456789, files aaaaaaaaaaaa": ["NASA, subject 50002, seed 0", "SNARF, subject 50002, seed 1 (train, id)"],
        "commit abcdef0123-dirty, files bbbbbbbbbbbb": [
            "SNARF, subject 50002, seed 0", "SNARF, subject 50002, seed 1 (ood)",
        ],
        "unknown version": ["NASA, subject 50002, seed 1"],
    }  # fmt: skip
    text = text_of(plan, tmp_path / "report")
    assert "- code: **3 versions**, listed at the end of the page\n" in text
    assert "## Versions of the code\n\n- commit 0123456789, files aaaaaaaaaaaa: NASA, subject 50002, seed 0; SNARF," in text


def test_a_training_that_another_version_continued_counts_for_both(plan):
    for job in plan.jobs:
        fake_run(job, VALUES, code=NEW)
    metrics = Path(plan.jobs[0].folder) / "metrics.json"
    write_json(metrics, read(metrics) | {"earlier_code": [OLD, {}]})
    found = code_versions(collected(plan))
    others = [job.name for job in plan.jobs[1:]]
    assert found == {
        "commit 0123456789, files aaaaaaaaaaaa": ["NASA, subject 50002, seed 0 (train)"],
        "unknown version": ["NASA, subject 50002, seed 0 (train)"],
        "commit abcdef0123-dirty, files bbbbbbbbbbbb": ["NASA, subject 50002, seed 0 (train, id, ood)", *others],
    }


def test_versions_are_told_apart_by_their_files(plan):
    first, second, third, fourth = plan.jobs
    fake_run(first, VALUES, code=OLD)
    fake_run(second, VALUES, code=OLD | {"commit": "9999999999"})  # a commit that changed documentation
    fake_run(third, VALUES, code={"digest": OLD["digest"]})  # the same files without a checkout
    fake_run(fourth, VALUES, code={"digest": OLD["digest"]})
    assert list(code_versions(collected(plan))) == ["commit 0123456789 = 9999999999, files aaaaaaaaaaaa"]


def test_several_machines_are_listed(plan, tmp_path):
    for number, job in enumerate(plan.jobs):
        fake_run(job, VALUES, machine=FAKE_MACHINE | {"threads": 1 + number % 2})
    assert [len(runs) for runs in machines(collected(plan)).values()] == [2, 2]
    text = text_of(plan, tmp_path / "report")
    assert "- machine: **2 combinations of machine and threads**, listed at the end of the page\n" in text
    assert "## Machines and threads\n\n- a processor, 2 cores, 1 thread per run" in text


def test_nothing_in_a_file_becomes_mark_up(plan, tmp_path):
    hostile = "[x](http://x)<b>\n# y"
    for job in plan.jobs:
        fake_run(job, VALUES, code={"digest": hostile, "commit": 3}, machine={"processor": hostile, "cores": [], "gpu": {}})
    text = text_of(plan, tmp_path / "report")
    assert "<b>" not in text
    assert "[x]" not in text
    assert "\n# y" not in text


def test_costs_of_runs_without_a_record_are_not_made_up(plan):
    assert cost_text(collected(plan)) == ""
    fake_run(plan.jobs[0], VALUES, spent_s={"train": 60.0})
    fake_run(plan.jobs[1], VALUES)
    assert cost_text(collected(plan)).startswith("1 of 4 runs: 60 s one after the other and 2 min of processor time")
