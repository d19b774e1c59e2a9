"""Reports that are written again whenever a run has ended."""

from __future__ import annotations

from fake_runs import fake_plan, fake_run

from snarfcli.reproduce.growing import GrowingReports, PlannedReport

VALUES = {"id": 0.9, "ood": 0.8}


def test_a_report_grows_with_its_runs(tmp_path, caplog):
    plan = fake_plan(tmp_path, systems=("nasa", "snarf"), seeds=(0, 1))
    report = PlannedReport(plan, tmp_path / "report", "snarf reproduce table1")
    growing = GrowingReports([report])
    first, second = plan.jobs[:2]
    fake_run(first, VALUES)
    growing.update(first.folder, {second.folder})
    page, table = tmp_path / "report/table1.md", tmp_path / "report/table1.csv"
    text = page.read_text()
    assert "**Unfinished: 1 of 4 runs done**; this page is written again after every run." in text
    assert "| [90.0](" in text
    assert "- SNARF, subject 50002, seed 0: running: not finished yet\n- 2 runs more: not run yet" in text
    assert "table1.csv" in {path.name for path in page.parent.iterdir()}
    assert ",running," in table.read_text()
    copy = tmp_path / "report/runs/50002/nasa-quick-s0/eval_id.json"
    before = copy.stat().st_mtime_ns
    fake_run(second, VALUES)
    growing.update(second.folder, set())
    assert "Unfinished: 2 of 4 runs done" in page.read_text()
    assert copy.stat().st_mtime_ns == before, "files that are there are not copied again"
    growing.update("another folder", set())
    growing.update(second.folder, {plan.jobs[2].folder})
    assert "running: not finished yet" in page.read_text()
    fake_run(plan.jobs[2], {}, "stopped", trained=False)
    growing.stop()
    text = page.read_text()
    assert "- NASA, subject 50002, seed 1: stopped: interrupted at train\n" in text
    assert "**Unfinished: 2 of 4 runs done**; the section Not done says why." in text, "nothing runs that would write it again"
    GrowingReports([PlannedReport(plan, tmp_path / "not begun", "snarf reproduce table1")]).stop()
    assert not (tmp_path / "not begun").exists()

    page.unlink()
    page.mkdir()
    for _ in range(2):
        growing.update(second.folder, set())
    assert caplog.text.count("warning: the table of the runs so far was not written") == 1
