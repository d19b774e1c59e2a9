"""Tables of made-up runs: means, deviations, failed runs, links, and the same numbers in Markdown and CSV."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import statistics
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import fake_plan, fake_run, fake_samples, read

from snarfcli.reproduce.durations import Durations
from snarfcli.reproduce.jobs import STATUS
from snarfcli.reproduce.papers import paper_numbers, paper_source
from snarfcli.reproduce.report import write_report
from snarfcli.reproduce.results import COLUMNS, collect, summarise
from snarfcli.reproduce.tables import csv_table, markdown_table, order_lines, plain_table

SURFACE = {column.key: column for column in COLUMNS}["surface_ood"]


@pytest.fixture
def plan(tmp_path):
    """Two systems, two subjects, three seeds."""
    systems = ("snarf", "ours-local")
    return fake_plan(tmp_path, subjects=("50002", "50004"), seeds=(0, 1, 2), systems=systems)


def value_of(job):
    """A surface IoU out of distribution that differs from run to run."""
    return 0.5 + (0.2 if job.row == "ours-local" else 0.0) + (0.1 if job.subject == "50004" else 0.0) + 0.01 * job.seed**2


def make_all(plan, broken=()):
    for job in plan.jobs:
        if (job.row, job.subject, job.seed) not in broken:
            fake_run(job, {"id": 0.9, "ood": value_of(job)})
    return [collect(job) for job in plan.jobs]


def test_means_are_over_seeds_then_subjects_and_deviations_over_seeds(plan):
    results = [result for result in make_all(plan) if result.job.row == "snarf"]
    cell = summarise(results, SURFACE)
    by_seed = [100 * (0.55 + 0.01 * seed**2) for seed in range(3)]
    assert cell.mean == pytest.approx(statistics.mean(by_seed))
    assert cell.deviation == pytest.approx(statistics.stdev(by_seed))
    assert cell.text(1) == f"{statistics.mean(by_seed):.1f} ± {statistics.stdev(by_seed):.1f}"
    one = summarise(results[:1], SURFACE)
    assert one.deviation is None
    assert one.text(1) == "50.0"
    times = {column.key: summarise(results, column).mean for column in COLUMNS}
    assert times["training_min"] == pytest.approx(100 * 0.6 / 60)
    assert times["total_ms"] == 31.0


def test_a_failed_run_is_in_the_cell_and_not_averaged_away(plan):
    diverged, failed = plan.jobs[0], plan.jobs[4]
    broken = {(job.row, job.subject, job.seed) for job in (diverged, failed)}
    assert {row for row, _, _ in broken} == {"snarf"}
    fake_run(diverged, {}, "diverged", "loss is NaN at step 7", trained=False)
    fake_run(failed, {}, "failed", "no samples", trained=False)
    results = make_all(plan, broken)
    cell = summarise([result for result in results if result.job.row == "snarf"], SURFACE)
    assert cell.count == 4
    assert cell.runs == 6
    assert cell.deviation is None
    assert re.fullmatch(r"4 of 6: [\d.]+ \(1 diverged, 1 failed\)", cell.text(1))
    alone = next(result for result in results if result.state == "diverged")
    assert summarise([alone], SURFACE).text(1) == "diverged"
    assert alone.reason == "train: loss is NaN at step 7"
    text = markdown_table(plan, results, lambda result, stage: None)
    assert "4 of 6:" in text
    assert "(1 diverged, 1 failed)" in text
    assert any("unknown, since not all runs are done" in line for line in order_lines(plan, results))


def test_runs_that_are_not_there_are_missing(plan):
    results = [collect(job) for job in plan.jobs]
    assert {result.state for result in results} == {"missing"}
    assert summarise(results, SURFACE).text(1) == "12 missing"
    assert summarise(results[:1], SURFACE).text(1) == "missing"


def test_only_numbers_of_the_same_settings_count(plan, tmp_path):
    job = plan.jobs[0]
    fake_run(job, {"id": 0.9, "ood": 0.5})
    other = fake_plan(tmp_path, subjects=("50002", "50004"), seeds=(0, 1, 2), systems=("snarf", "ours-local"), surface_frames=4)
    result = collect(other.jobs[0])
    assert result.files.keys() == {"train"}, "evaluated without surfaces, so it must be evaluated again"
    reason = "evaluation id and ood: there is none of this avatar with these settings"
    assert (result.state, result.reason) == ("missing", reason)
    assert summarise([result], SURFACE).text(1) == "missing"
    status = read(tmp_path / "outputs/builtin/50002/snarf-quick-s0" / STATUS)
    assert status["digest"] == job.digest
    longer = fake_plan(tmp_path, systems=("snarf",), training="standard")
    assert longer.jobs[0].digest != job.digest
    assert longer.jobs[0].folder != job.folder


def test_an_evaluation_that_is_older_than_its_avatar_is_missing(tmp_path):
    plan = fake_plan(tmp_path, systems=("snarf",))
    fake_run(plan.jobs[0], {"id": 0.9, "ood": 0.5})
    os.utime(plan.jobs[0].evaluations[1].metrics, (1, 1))  # as after a copy that does not keep the times
    result = collect(plan.jobs[0])
    assert result.state == "missing"
    assert result.reason.startswith("evaluation ood: ")
    Path(plan.jobs[0].evaluations[1].metrics).unlink()
    assert collect(plan.jobs[0]) == result
    write_report(plan, [result], tmp_path / "report", "command")
    text = (tmp_path / "report/table1.md").read_text()
    assert "**Unfinished: 0 of 1 run done**" in text
    assert "- SNARF, subject 50002, seed 0: missing: evaluation ood" in text


DAMAGED = ("{", "[]", '{"machine": 3}', '{"timings": {"seconds_per_step": NaN}}', '{"steps": 1' + 400 * "0" + "}")


@pytest.mark.parametrize("content", DAMAGED, ids=lambda content: content[:40])
@pytest.mark.parametrize("stage", ["train", "ood"])
def test_a_damaged_file_of_one_run_leaves_the_others_in_the_report(tmp_path, content, stage):
    plan = fake_plan(tmp_path, systems=("snarf",), seeds=(0, 1))
    for job in plan.jobs:
        fake_run(job, {"id": 0.9, "ood": 0.5})
    evaluation = plan.jobs[0].evaluations[1]
    path = Path(evaluation.metrics) if stage == "ood" else Path(plan.jobs[0].folder) / "metrics.json"
    if stage == "ood" and content.startswith("{") and len(content) > 1:
        content = content[:-1] + f', "settings": {json.dumps(evaluation.settings)}}}'  # so that it counts
    path.write_text(content)
    durations = Durations(tmp_path / "durations.json", plan.jobs, None, 1)
    assert all(durations.of(job).total_s > 0 for job in plan.jobs)
    results = [collect(job) for job in plan.jobs]
    assert [result.state for result in results] == ["missing", "done"]
    assert stage not in results[0].files
    write_report(plan, results, tmp_path / "report", "command")
    text = (tmp_path / "report/table1.md").read_text()
    assert "**Unfinished: 1 of 2 runs done**" in text
    assert "1 of 2: 50.0 (1 missing)" in text or stage == "train"


def test_names_and_reasons_are_no_mark_up(tmp_path):
    plan = fake_plan(tmp_path, systems=("snarf",), seeds=(0, 1))
    jobs = [replace(job, subject="a (1) b") for job in plan.jobs]
    fake_run(jobs[0], {"id": 0.9, "ood": 0.5})
    fake_run(jobs[1], {}, "failed", "no [x](http://x) <b>", trained=False)
    write_report(plan, [collect(job) for job in jobs], tmp_path / "report", "command")
    text = (tmp_path / "report/table1.md").read_text()
    assert "[90.0](runs/a%20%281%29%20b/snarf-quick-s0/eval_id.json)" in text
    assert (tmp_path / "report/runs/a (1) b/snarf-quick-s0/eval_id.json").is_file()
    assert "<b>" not in text
    assert "[x]" not in text


def test_data_without_a_split_has_a_dash(tmp_path):
    plan = fake_plan(tmp_path, systems=("snarf",))
    fake_samples(tmp_path / "data", "50002", ood=0)
    fake_run(plan.jobs[0], {"id": 0.9})
    result = collect(plan.jobs[0])
    assert result.state == "done"
    assert summarise([result], SURFACE).text(1) == "–"


def test_the_report_links_every_number_to_a_file_and_equals_its_csv(plan, tmp_path):
    results = make_all(plan)
    folder = tmp_path / "report"
    paths = write_report(plan, results, folder, "snarf reproduce table1", about="2 runs at a time")
    text = (folder / "table1.md").read_text()
    assert {path.name for path in paths} == {"table1.md", "table1.csv"}
    for said in ("    snarf reproduce table1\n", "a processor, 2 cores", "PyTorch 2", "seeds 0, 1, 2", "steps 100", "97.31"):
        assert said in text, said
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) > 100
    for link in links:
        if link.startswith("#"):
            assert f'<a id="{link[1:]}"></a>' in text
        else:
            content = read(folder / link)
            assert content["iou_surface" if "eval" in link else "steps"]
    rows = list(csv.DictReader(io.StringIO((folder / "table1.csv").read_text())))
    runs = [row for row in rows if row["level"] == "run"]
    assert len(runs) == len(plan.jobs)
    for row, job in zip(sorted(runs, key=str), sorted(plan.jobs, key=lambda job: job.folder), strict=True):
        assert row["state"] == "done"
        assert read(folder / row["ood_file"])["iou_surface"] == pytest.approx(float(row["surface_ood"]) / 100, rel=1e-5)
        assert job.row in {"snarf", "ours-local"}
    summaries = {row["row"]: row for row in rows if row["level"] == "all"}
    for key, row in summaries.items():
        cell = summarise([result for result in results if result.job.row == key], SURFACE)
        assert f"{float(row['surface_ood']):.1f} ± {float(row['surface_ood_sd']):.1f}" == cell.text(1)
        assert f"[{cell.text(1)}](#{key})" in text
    assert {row["subject"] for row in rows if row["level"] == "paper"} == {"", "50002", "50004"}


def test_files_are_copied_without_their_frames(tmp_path):
    plan = fake_plan(tmp_path, systems=("snarf",))
    fake_run(plan.jobs[0], {"id": 0.9, "ood": 0.5})
    write_report(plan, [collect(plan.jobs[0])], tmp_path / "report", "command")
    for evaluation in plan.jobs[0].evaluations:
        content = read(tmp_path / evaluation.metrics)
        for sequence in content["sequences"].values():
            assert sequence.pop("per_frame")
        assert read(tmp_path / f"report/runs/50002/snarf-quick-s0/eval_{evaluation.split}.json") == content


def test_the_order_of_the_papers_is_compared(plan):
    lines = order_lines(plan, make_all(plan))
    assert lines == ["ours, condition=local over SNARF: +20.0 points, standard deviation over seeds 2.9: holds"]
    for job in plan.jobs:
        fake_run(job, {"id": 0.9, "ood": 0.5 if job.row == "ours-local" else 0.6})
    (line,) = order_lines(plan, [collect(job) for job in plan.jobs])
    assert line.endswith(": -10.0 points, standard deviation over seeds 0.0: does not hold")


def test_the_terminal_shows_the_papers_numbers_too(plan):
    text = plain_table(plan, make_all(plan))
    assert "(80.65)" in text
    assert len({len(line) for line in text.splitlines()} - {0}) >= 1
    assert csv_table(plan, [collect(job) for job in plan.jobs], lambda result, stage: None)


def test_the_papers_averages_are_near_the_means_of_their_subjects():
    subjects = ("50002", "50004", "50007", "50009", "50020", "50021", "50022", "50025", "50026", "50027")
    for system in ("pose_onet", "back_d", "back_lbs", "nasa", "snarf"):
        mean = paper_numbers("table1", system)
        values = [paper_numbers("table1", system, subject) for subject in subjects]
        for key in ("bbox_id", "surface_id", "bbox_ood", "surface_ood"):
            # the table's own averages are up to 0.86 off, at NASA's and Back-LBS's
            assert statistics.mean(value[key] for value in values) == pytest.approx(mean[key], abs=0.9)
    assert paper_numbers("table2", "grid128")["surface_ood"] == 81.5
    assert paper_source("table2") == "Fast-SNARF Table 2"
    assert paper_numbers("ablations", "snarf") == {}
    assert paper_numbers("table1", "fast_snarf", "50002") == {}
