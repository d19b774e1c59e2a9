"""`snarf reproduce`: its arguments, and a whole table of a bending capsule."""

from __future__ import annotations

import csv
import io
import logging
import re
from dataclasses import asdict
from pathlib import Path

import pytest
from fake_runs import fake_run
from omegaconf import OmegaConf
from toy_training import toy_store

from snarfcli.cli import main as cli
from snarfcli.commands import reproduce
from snarfcli.commands.reproduce import ReproduceConfig, run
from snarfcli.hydra_config.overrides import quote_items
from snarfcli.hydra_config.schema import config_folder
from snarfcli.reproduce.jobs import JobStatus, run_job
from snarfcli.reproduce.running import JobStopped


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(capsys, *arguments):
    code = cli.main(["reproduce", *arguments])
    out, err = capsys.readouterr()
    return code, out, err


WRONG = {
    (
        "tabel1",
    ): "what: wanted table1, table2, ablations, minutes, stick2d, clothed or all, got 'tabel1'; did you mean 'table1'?",
    (): "what: wanted table1, table2, ablations, minutes, stick2d, clothed or all, got none",
    ("table1", "systems=[nsa]"): "there is no row 'nsa'; did you mean 'nasa'?",
    ("table1", "training=quik"): "there is no training=quik; did you mean 'quick'?",
    ("table1", "data=cap"): "data: wanted builtin or dfaust for table1, got 'cap'",
    ("table1", "subjects=[50003]"): "no subject '50003'; did you mean '500",
    ("table1", "extra=[training.stps=1]"): "row pose_onet: unknown setting 'training.stps'; did you mean 'training.steps'?",
    ("table1", "launcher=slurm"): "launcher: wanted local, joblib",
    ("table1", "processes=0"): "processes: wanted at least 1, got 0",
    ("table1", "launcher_settings=[partition=gpu]"): "launcher_settings: wanted none with launcher=local",
    ("table1", "launcher_settings=[gpu]"): "launcher_settings: wanted settings such as [partition=gpu], got 'gpu'",
    ("table1", "table2"): "wanted a setting NAME=VALUE, got 'table2'",
    ("table1", "sistems=[nasa]"): "unknown setting 'sistems'; did you mean 'systems'?",
}


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_a_user_error_is_one_line_with_code_2(capsys, elsewhere, arguments):
    code, out, err = call(capsys, *arguments)
    assert code == 2
    assert WRONG[arguments] in err
    assert len(err.strip().splitlines()) == 1
    assert "Traceback" not in out + err
    assert not list(elsewhere.iterdir()), "something was left behind"


def test_a_dry_run_prints_commands_and_does_nothing(capsys, caplog, elsewhere):
    caplog.set_level(logging.INFO, "snarfcli")
    extra = "extra=[training.steps=9,skinning.resolution=[8,8,4]]"
    code, _, err = call(capsys, "table1", "--dry-run", "measure=false", "subjects=[50002]", "systems=[nasa]", extra)
    assert code == 0, err
    assert "run 1 of 1: nasa: NASA, subject 50002, seed 0, outputs/builtin/50002/nasa-quick-s0-" in caplog.text
    assert "snarf preprocess subject='50002' data=builtin" in caplog.text
    assert (
        "model=nasa condition=global shape=small skinning=coarse training.agreement_weight=0.0 "
        "training.steps=9 skinning.resolution=[8,8,4] seed=0" in caplog.text
    )
    assert "1 run to run: about " in caplog.text
    assert "not measured, rough" in caplog.text
    assert not list(elsewhere.iterdir())


def test_lists_of_settings_may_be_written_plainly():
    from hydra.core.override_parser.overrides_parser import OverridesParser

    for text, wanted in {
        "[a=1]": ["a=1"],
        "[a=1,b.c=[1,2],d={x:1,y:2}]": ["a=1", "b.c=[1,2]", "d={x:1,y:2}"],
        "[]": [],
        "['a=1', \"b=it's\"]": ["a=1", "b=it's"],
        "[a=x'y,z']": ["a=x'y,z'"],
    }.items():
        assert OverridesParser.create().parse_override(f"extra={quote_items(text)}").value() == wanted, text
    assert quote_items("null") == "null"


def test_the_command_is_written_as_it_can_be_typed():
    defaults = OmegaConf.to_container(OmegaConf.load(config_folder() / "reproduce" / "reproduce.yaml"))
    defaults.pop("defaults")
    config = ReproduceConfig(**{**defaults, "what": "table1", "subjects": ["50002"], "extra": ["a.b=1"], "figures": False})
    assert reproduce._command(config) == "snarf reproduce table1 subjects=[50002] extra=[a.b=1] figures=false"


def in_this_process(arguments, log, stopped):
    """Run a command of a job in this process; a new one would take seconds to start."""
    if stopped():
        raise JobStopped
    Path(log).parent.mkdir(parents=True, exist_ok=True)
    Path(log).touch()
    return cli.main(arguments)


def test_a_whole_table_of_a_toy(tmp_path, monkeypatch, caplog):
    """Systems that train, one that fails, and the same command again."""
    toy_store(tmp_path / "data", points=400, frames=8)
    caplog.set_level(logging.INFO, "snarfcli")
    defaults = OmegaConf.to_container(OmegaConf.load(config_folder() / "reproduce" / "reproduce.yaml"))
    defaults.pop("defaults")
    config = ReproduceConfig(**defaults | {
        "what": "table1", "subjects": ["toy"], "training": "smoke", "systems": ["back_d", "fast_snarf-broyden", "ours-local"],
        "data_root": str(tmp_path / "data"), "output_root": str(tmp_path / "outputs"), "figure_resolution": 16, "threads": 1,
        "extra": ["training.steps=3", "training.validate_every=3", "skinning.resolution=[8,8,8]", "shape.width=16",
               "skinning.bone_radius_m=0.3"],
    })  # fmt: skip
    calls = []

    grown = []

    def launch(jobs, folder, launcher, on_change, on_look):
        for number, job in enumerate(jobs):

            def runner(arguments, log, stopped, job=job):
                calls.append((job.row, arguments[0]))
                if job.row == "back_d":
                    Path(log).write_text("busy\nsnarf train: no such luck\n")
                    return 2
                return in_this_process(arguments, log, stopped)

            on_change(number, JobStatus("running"))
            on_look()
            on_change(number, run_job(job, runner=runner))
            grown.append((tmp_path / "outputs/reproduce/table1/table1.md").read_text())

    monkeypatch.setattr(reproduce, "launch", launch)
    assert run(config) == 1, "one failed"
    assert [call for call in calls if call[0] == "ours-local"] == [("ours-local", name) for name in ("train", "eval", "eval")]
    assert [text.count("not run yet") for text in grown] == [1, 1, 0]
    assert [re.findall(r"\*\*Unfinished: (.*)\*\*; this", text) for text in grown] == [
        ["1 of 3 runs done"], ["1 of 3 runs done"], ["2 of 3 runs done"],
    ]  # fmt: skip
    folder = tmp_path / "outputs/reproduce/table1"
    text = (folder / "table1.md").read_text()
    assert "| Back-D | failed | failed |" in text
    assert "- Back-D, subject toy, seed 0: failed: train: no such luck" in text
    rows = list(csv.DictReader(io.StringIO((folder / "table1.csv").read_text())))
    of_runs = {row["row"]: row for row in rows if row["level"] == "run"}
    assert {row: of_runs[row]["state"] for row in of_runs} == {
        "back_d": "failed", "fast_snarf-broyden": "done", "ours-local": "done",
    }  # fmt: skip
    assert all(0 <= float(of_runs["ours-local"][name]) <= 100 for name in ("bbox_id", "surface_id", "bbox_ood", "surface_ood"))
    assert (folder / of_runs["ours-local"]["ood_file"]).is_file()
    drawn = {path.name for path in (folder / "figures").iterdir()}
    assert drawn == {"systems.png", "weights.png", "training.png", "frames.png"}, "one sequence has no curve"
    assert "**Unfinished: 2 of 3 runs done**; the section Not done says why." in text
    assert "2 of 3: Back-D, subject toy, seed 0: failed (train: no such luck)" in caplog.text
    known = (tmp_path / "outputs/reproduce/durations.json").read_text()
    assert known.count('"row": "ours-local"') == 1
    assert "IoU in/out of distribution" in caplog.text

    calls.clear()
    assert run(config) == 1
    assert set(calls) == {("back_d", "train")}, "what is done is not done again"
    again = ReproduceConfig(**asdict(config) | {"only_report": True, "systems": ["ours-local", "nasa"], "figures": False})
    calls.clear()
    assert run(again) == 1
    assert calls == []
    assert "| NASA | missing | missing |" in (folder / "table1.md").read_text()


def test_ctrl_c_leaves_a_table_of_the_runs_so_far(tmp_path, monkeypatch, caplog):
    toy_store(tmp_path / "data", points=400, frames=8)
    caplog.set_level(logging.INFO, "snarfcli")
    defaults = OmegaConf.to_container(OmegaConf.load(config_folder() / "reproduce" / "reproduce.yaml"))
    defaults.pop("defaults")
    config = ReproduceConfig(**defaults | {
        "what": "table1", "subjects": ["toy"], "systems": ["back_d", "nasa"], "data_root": str(tmp_path / "data"),
        "output_root": str(tmp_path / "outputs"),
    })  # fmt: skip

    def launch(jobs, folder, launcher, on_change, on_look):
        for number, job in enumerate(jobs):
            on_change(number, JobStatus("running"))
            fake_run(job, {"id": 0.9, "ood": 0.8}, "stopped" if number else "done", trained=not number)
        on_change(0, JobStatus("done", seconds={"train": 1.0}))
        on_change(1, JobStatus("stopped"))
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduce, "launch", launch)
    with pytest.raises(KeyboardInterrupt):
        run(config)
    assert "stopped with 1 of 2 runs done; run the same command to continue from the last checkpoints" in caplog.text
    text = (tmp_path / "outputs/reproduce/table1/table1.md").read_text()
    assert "**Unfinished: 1 of 2 runs done**" in text
    assert "- Back-D, subject toy, seed 0: stopped: interrupted at train" in text, "not as if it still ran"
