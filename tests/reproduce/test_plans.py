"""Plans: the settings of all rows exist, every run has a different folder, and wrong options are rejected before any work."""

from __future__ import annotations

import pytest
from fake_runs import fake_plan, fake_samples

from snarfcli.commands.preprocess import PreprocessConfig
from snarfcli.commands.reproduce import resolve_training
from snarfcli.commands.train import TrainConfig
from snarfcli.descriptions import read_described
from snarfcli.errors import UserError
from snarfcli.hydra_config.overrides import check_overrides
from snarfcli.reproduce.experiments import EXPERIMENTS
from snarfcli.reproduce.papers import paper_numbers
from snarfcli.reproduce.planning import choose_experiments, make_plan
from snarfcli.reproduce.plans import ExperimentOptions, Job, unique_jobs


def overrides_of(arguments):
    return [argument for argument in arguments if "=" in argument]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_row_of_every_experiment_has_settings_of_the_commands(name, tmp_path):
    from snarfcli.commands.evaluate import EvalConfig

    experiment = EXPERIMENTS[name]
    subjects = experiment.subjects[experiment.data[0]]
    for subject in subjects:
        fake_samples(tmp_path, subject, experiment.data[0])
    systems = tuple(row.key for row in experiment.rows)
    plan = make_plan(experiment, ExperimentOptions(data_root=str(tmp_path), seeds=(0, 1), systems=systems), resolve_training)
    assert len(plan.jobs) == 2 * len(subjects) * len(experiment.rows)
    for job in plan.jobs:
        check_overrides(overrides_of(job.train), TrainConfig, "train")
        for samples in job.samples:
            check_overrides(overrides_of(samples.arguments), PreprocessConfig, "preprocess")
        for evaluation in job.evaluations:
            check_overrides(overrides_of(evaluation.arguments), EvalConfig, "eval")
    assert len({job.folder for job in plan.jobs}) == len(plan.jobs)
    # rows differ in their settings, except where the preset has the same value or only the samples differ
    seed0 = [job for job in plan.jobs if job.seed == 0 and job.subject == subjects[0]]
    same = {"fast_snarf-broyden", "grid32"}  # the coarse grid of quick
    assert len({job.digest for job in seed0}) == len(seed0) - (same <= {job.row for job in seed0})


def test_a_key_stands_for_one_set_of_overrides():
    rows: dict[tuple[str, str], tuple] = {}
    for experiment in EXPERIMENTS.values():
        for data in experiment.data:
            for row in experiment.rows:
                what = (row.settings("quick"), row.inside_test)
                assert rows.setdefault((data, row.key), what) == what, row.key
        keys = [row.key for row in experiment.rows]
        assert len(set(keys)) == len(keys)
        assert set(experiment.order) <= set(keys)
        for row in experiment.rows if experiment.name in ("table1", "table2") else ():
            assert row.paper is None or paper_numbers(experiment.name, row.paper), row.key


def test_optional_rows_are_there_when_they_are_named(tmp_path):
    assert "snarf-hour" not in {job.row for job in fake_plan(tmp_path).jobs}
    job = fake_plan(tmp_path, systems=("snarf-hour",)).jobs[0]
    config = resolve_training([one for one in job.train[2:] if one.split("=")[0] in ("training", "model", "search")])
    assert (config["search"]["init_bones"], config["search"]["max_steps"]) == (None, 20), "SNARF's own search"


def test_other_settings_have_other_folders_and_machines_do_not_matter(tmp_path):
    plain = fake_plan(tmp_path, systems=("snarf",)).jobs[0]
    extra = fake_plan(tmp_path, systems=("snarf",), extra=("training.steps=7",)).jobs[0]
    assert plain.folder.endswith("snarf-quick-s0")
    assert extra.folder.startswith(f"{plain.folder}-")
    assert extra.digest != plain.digest
    assert "training.steps=7" in extra.train
    elsewhere = fake_plan(tmp_path, systems=("snarf",), device="cuda", threads=3).jobs[0]
    assert elsewhere.digest == plain.digest
    assert {"device=cuda", "threads=3"} <= set(elsewhere.train)
    assert "resume=true" in plain.train
    assert not [one for one in plain.train if one.startswith("threads")]


def test_runs_are_told_apart_by_what_changes_the_avatar_alone():
    # a setting that comes to these makes the digests of all existing runs differ
    settings = {"data", "model", "skinning", "search", "shape", "condition", "training", "experiment"}
    assert set(resolve_training(["training=quick"])) == settings


def test_a_whole_table_comes_before_the_second_seed(tmp_path):
    plan = fake_plan(tmp_path, subjects=("50002", "50004"), seeds=(3, 1), systems=("nasa", "snarf"))
    assert [(job.seed, job.subject, job.row) for job in plan.jobs] == [
        (seed, subject, row) for seed in (3, 1) for subject in ("50002", "50004") for row in ("nasa", "snarf")
    ]


def test_parity_trains_on_samples_of_its_own_and_is_evaluated_on_the_others(tmp_path):
    job = fake_plan(tmp_path, "ablations", systems=("parity",)).jobs[0]
    assert [samples.folder for samples in job.samples] == [
        str(tmp_path / "data/processed/builtin/50002"), str(tmp_path / "data/parity/processed/builtin/50002"),
    ]  # fmt: skip
    assert "inside_test=parity" in job.samples[1].arguments
    assert "inside_test=parity" not in job.samples[0].arguments
    assert f"data_root='{tmp_path}/data/parity'" in job.train
    assert all(evaluation.data_root == str(tmp_path / "data") for evaluation in job.evaluations)


def test_dfaust_is_evaluated_on_poseprior(tmp_path):
    for data in ("dfaust", "poseprior"):
        fake_samples(tmp_path / "data", "50002", data)
    job = fake_plan(tmp_path, data="dfaust", systems=("snarf",)).jobs[0]
    assert {evaluation.split: evaluation.data for evaluation in job.evaluations} == {"id": "dfaust", "ood": "poseprior"}
    assert job.evaluations[1].metrics.endswith("eval_ood_poseprior/metrics.json")
    assert len(job.samples) == 2


def test_jobs_survive_being_written_down(tmp_path):
    import json
    from dataclasses import asdict

    for job in fake_plan(tmp_path, "ablations").jobs:
        assert read_described(Job, json.loads(json.dumps(asdict(job))), "job") == job


def test_all_runs_what_experiments_share_once(tmp_path):
    chosen = choose_experiments("all", ExperimentOptions(data="dfaust", subjects=("50002",), training="paper"))
    assert [(one.name, part.data, part.subjects, part.training) for one, part in chosen] == [
        ("table1", "dfaust", ("50002",), "paper"), ("table2", "dfaust", ("50002",), "paper"),
        ("ablations", "dfaust", ("50002",), "paper"), ("minutes", "dfaust", ("50002",), "paper"),
        ("stick2d", None, (), None), ("clothed", "cape", (), "paper"),
    ]  # fmt: skip
    steps = ("training.steps=9",)
    with_steps = [one.name for one, _ in choose_experiments("all", ExperimentOptions(extra=steps))]
    assert with_steps == ["table1", "table2", "ablations", "stick2d", "clothed"], "the minutes of the other one exclude them"
    with_row = choose_experiments("all", ExperimentOptions(extra=steps, systems=("ours-2",)))
    assert [one.name for one, _ in with_row] == ["minutes"], "which is then an error that says so"
    plans = [fake_plan(tmp_path, name) for name in ("table1", "table2", "ablations")]
    jobs = unique_jobs(plans)
    assert len(jobs) == len({job.folder for plan in plans for job in plan.jobs}) < sum(len(plan.jobs) for plan in plans)
    assert next(job.label for job in jobs if job.row == "ours-global") == "ours, condition=global", "the first table's name"


WRONG = [
    ({"systems": ("nsa",)}, "there is no row 'nsa'; did you mean 'nasa'?"),
    ({"training": "quik"}, "there is no training=quik; did you mean 'quick'?"),
    ({"data": "cape"}, "data: wanted builtin or dfaust for table1, got 'cape'"),
    ({"seeds": (1, 1)}, "seeds: wanted different"),
    ({"seeds": ()}, "seeds: wanted different whole numbers from 0, at least one"),
    ({"extra": ("seed=3",)}, "extra: seed is set by reproduce itself; give seeds="),
]


@pytest.mark.parametrize(("choice", "message"), WRONG)
def test_a_choice_that_cannot_be_made_is_rejected(choice, message, tmp_path):
    with pytest.raises(UserError) as error:
        fake_plan(tmp_path, **choice)
    assert message in str(error.value)


def test_subjects_must_be_there_before_anything_runs(tmp_path):
    with pytest.raises(UserError, match="no subject '50003'; did you mean"):
        make_plan(EXPERIMENTS["table1"], ExperimentOptions(subjects=("50003",), data_root=str(tmp_path)), resolve_training)
    with pytest.raises(UserError, match=r"(?i)dfaust"):
        make_plan(EXPERIMENTS["table1"], ExperimentOptions(data="dfaust", data_root=str(tmp_path)), resolve_training)


def test_experiments_are_known_by_name():
    with pytest.raises(UserError, match=r"what: wanted table1, .* or all, got 'tabel1'; did you mean 'table1'"):
        choose_experiments("tabel1", ExperimentOptions())
    with pytest.raises(UserError, match=r"row pose_onet: unknown setting 'training.stps'"):
        make_plan(EXPERIMENTS["table1"], ExperimentOptions(extra=("training.stps=3",)), resolve_training)
