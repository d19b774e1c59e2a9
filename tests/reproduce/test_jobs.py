"""One run of a plan with fake commands: which stages run, which are repeated, and the recorded status."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import fake_metrics, fake_plan, fake_samples

from snarfcli.files import write_json
from snarfcli.reproduce import jobs
from snarfcli.reproduce.jobs import STATUS, read_status, run_job
from snarfcli.reproduce.results import collect
from snarfcli.reproduce.running import JobStopped


class Player:
    """Replaces `snarf`: writes the files that its commands write, and fails or stops at given stages."""

    def __init__(self, job, **codes: int) -> None:
        self.job, self.codes, self.calls = job, codes, []

    def __call__(self, arguments, log, stopped):
        command = next((a.split("=")[1] for a in arguments if a.startswith("split=")), arguments[0])
        self.calls.append(command)
        with Path(log).open("a") as file:
            file.write(f"$ snarf {command}\nbusy\n")
            code = self.codes.get(command, 0)
            if code == 130:
                raise JobStopped
            if code:
                file.write(f"snarf {command}: the reason: what to do\n")
                return code
        self.play(command)
        return 0

    def play(self, command):
        folder = Path(self.job.folder)
        if command == "preprocess":
            fake_samples(folder.parents[3] / "data", self.job.subject)
        elif command == "train":
            write_json(folder / "metrics.json", {"status": "trained", "steps": 10, "timings": {"seconds_per_step": 1.0}})
            (folder / "avatar.pt").write_bytes(b"avatar")
        else:
            evaluation = next(one for one in self.job.evaluations if one.split == command)
            write_json(evaluation.metrics, fake_metrics(0.8, evaluation.settings))


@pytest.fixture
def job(tmp_path):
    return fake_plan(tmp_path, systems=("snarf",)).jobs[0]


def test_everything_is_done_once(job):
    player = Player(job)
    status = run_job(job, runner=player)
    assert player.calls == ["train", "id", "ood"]
    assert status.state == "done"
    assert status.trained
    assert set(status.seconds) == {"train", "id", "ood"}
    assert read_status(Path(job.folder)) == status
    assert collect(job).values["surface_ood"] == 80.0
    again = Player(job)
    assert run_job(job, runner=again).state == "done"
    assert again.calls == []


def test_missing_samples_are_made_first(job, tmp_path):
    (tmp_path / "data/processed/builtin/50002/manifest.json").unlink()
    player = Player(job)
    assert run_job(job, runner=player).state == "done"
    assert player.calls == ["preprocess", "train", "id", "ood"]


def test_an_interrupted_run_goes_on_at_the_stage_where_it_stopped(job):
    for stage, left in (("train", ["train", "id", "ood"]), ("ood", ["ood"])):
        status = run_job(job, runner=Player(job, **{stage: 130}))
        assert status.state == "stopped"
        assert status.stage == stage
        assert collect(job).state == "stopped"
        assert f"interrupted at {stage}" in collect(job).reason
        player = Player(job, ood=130 if stage == "train" else 0)
        run_job(job, runner=player)
        assert player.calls == left
    assert collect(job).state == "done"


def test_times_of_all_calls_are_added(job, monkeypatch):
    """By clocks that every command moves: by 10 s, in which two threads compute for 15 s."""
    clock = {"wall": 0.0, "processor": 0.0}
    monkeypatch.setattr(jobs.time, "monotonic", lambda: clock["wall"])
    monkeypatch.setattr(jobs, "processor_s_of_children", lambda: clock["processor"])

    class Slow(Player):
        def __call__(self, arguments, log, stopped):
            clock["wall"] += 10.0
            clock["processor"] += 15.0
            return super().__call__(arguments, log, stopped)

    run_job(job, runner=Slow(job, train=130))
    status = run_job(job, runner=Slow(job))
    assert status.seconds == {"train": 10.0, "id": 10.0, "ood": 10.0}
    assert status.spent_s == {"train": 20.0, "id": 10.0, "ood": 10.0}
    assert status.processor_s == {"train": 30.0, "id": 15.0, "ood": 15.0}
    again = run_job(job, runner=Slow(job))
    assert (again.seconds, again.spent_s) == ({}, status.spent_s), "kept when there is nothing to do"
    other = type(job)(**{**vars(job), "digest": "another"})
    assert run_job(other, runner=Slow(other)).spent_s["train"] == 10.0, "another run in the same folder"


def test_a_stopped_plan_begins_nothing(job):
    player = Player(job)
    assert run_job(job, runner=player, stopped=lambda: True).state == "stopped"
    assert player.calls == []
    assert not (Path(job.folder) / STATUS).exists()


def test_a_failure_is_kept_with_its_reason_and_tried_again(job):
    status = run_job(job, runner=Player(job, train=2))
    assert (status.state, status.stage, status.reason, status.trained) == ("failed", "train", "the reason: what to do", False)
    result = collect(job)
    assert result.state == "failed"
    assert result.values == {}
    assert "the reason" in result.reason
    player = Player(job)
    assert run_job(job, runner=player).state == "done"
    assert player.calls == ["train", "id", "ood"]


def test_a_failed_evaluation_leaves_the_numbers_of_the_other(job):
    assert run_job(job, runner=Player(job, ood=1)).state == "failed"
    result = collect(job)
    assert result.values["surface_id"] == 80.0
    assert "surface_ood" not in result.values
    player = Player(job)
    assert run_job(job, runner=player).state == "done"
    assert player.calls == ["ood"]


def test_a_diverged_run_stays_so(job):
    class Diverging(Player):
        def __call__(self, arguments, log, stopped):
            code = super().__call__(arguments, log, stopped)
            write_json(Path(self.job.folder) / "metrics.json", {"status": "diverged", "steps": 5})
            return code

    assert run_job(job, runner=Diverging(job, train=2)).state == "diverged"
    assert collect(job).state == "diverged"
    again = Player(job)
    assert run_job(job, runner=again).state == "diverged"
    assert again.calls == [], "the same seed would lead there again"


def test_a_new_avatar_is_evaluated_anew(job):
    run_job(job, runner=Player(job))
    later = time.time() + 5
    os.utime(Path(job.folder) / "avatar.pt", (later, later))
    assert "surface_id" not in collect(job).values, "numbers of an older avatar"
    player = Player(job, id=2)
    run_job(job, runner=player)
    assert player.calls == ["id"]
    assert not Path(job.evaluations[0].metrics).exists()


def test_other_settings_are_left_to_train_to_judge(job, tmp_path):
    run_job(job, runner=Player(job))
    other = fake_plan(tmp_path, systems=("snarf",)).jobs[0]
    other = type(other)(**{**vars(other), "digest": "another"})
    assert collect(other).state == "missing"
    assert "other settings" in collect(other).reason
    player = Player(other, train=2)
    assert run_job(other, runner=player).state == "failed"
    assert player.calls == ["train"]


def test_data_without_the_split_is_no_failure(job, tmp_path):
    fake_samples(tmp_path / "data", "50002", ood=0)
    player = Player(job)
    assert run_job(job, runner=player).state == "done"
    assert player.calls == ["train", "id"]


def test_the_reason_of_a_real_command_is_told(job):
    wrong = type(job)(**{**vars(job), "train": ("train", "training=quik")})
    assert "there is no training=quik" in run_job(wrong).reason


def test_a_command_that_is_killed_is_named(job):
    def killed(arguments, log, stopped):
        Path(log).write_text("busy\n")
        return -signal.SIGKILL

    status = run_job(job, runner=killed)
    assert (status.reason, status.tries, status.retry) == ("ended by SIGKILL (out of memory?)", 1, "alone")
    status = run_job(job, runner=killed, tries=2)
    assert (status.tries, status.retry) == (2, ""), "once more, not again and again"
    assert read_status(Path(job.folder)) == status


def test_a_wrong_setting_and_a_diverged_run_are_not_tried_again(job):
    assert run_job(job, runner=Player(job, train=2)).retry == ""
    write_json(Path(job.folder) / "metrics.json", {"status": "diverged", "steps": 5})
    status = run_job(job, runner=lambda *_: -signal.SIGSEGV)
    assert (status.state, status.retry) == ("diverged", "")


def test_each_command_gets_its_share_of_the_threads(job):
    shares = iter((1, 2, None))
    seen = []

    def runner(arguments, log, stopped):
        seen.append([argument for argument in arguments if argument.startswith("threads=")])
        return Player(job)(arguments, log, stopped)

    status = run_job(job, runner=runner, threads=lambda: next(shares))
    assert seen == [["threads=1"], ["threads=2"], []]
    assert run_job(job, threads=lambda: 4) == replace(status, seconds={}), "with other threads it is still done"
    given = replace(job, digest="another", train=(*job.train, "threads=3"))
    seen.clear()
    run_job(given, runner=runner, threads=lambda: 4)
    assert seen[0] == ["threads=3"]
