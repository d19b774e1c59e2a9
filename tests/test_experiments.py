"""Presets of whole experiments: `experiment=` on the command line, together with other settings."""

from __future__ import annotations

import importlib
import itertools

import pytest
import yaml

from snarfcli.cli import main as cli
from snarfcli.hydra_config.schema import config_folder, group_options, preset_groups

NAMES = ("preprocess", "train", "eval", "animate", "export")


def composed(capsys, *arguments):
    """Return the configuration of a command."""
    code = cli.main([*arguments, "--cfg", "job"])
    out, err = capsys.readouterr()
    assert code == 0, err
    return yaml.safe_load(out)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_none_is_chosen_by_default(capsys):
    for command in NAMES:
        assert composed(capsys, command)["experiment"] is None


@pytest.mark.parametrize("training", ["quick", "paper"])
@pytest.mark.parametrize("is_first", [True, False])
def test_cape_changes_what_the_preset_of_training_says_in_any_order(capsys, training, is_first):
    choices = ["experiment=cape", f"training={training}"]
    config = composed(capsys, "train", *(choices if is_first else choices[::-1]))
    without = composed(capsys, "train", f"training={training}")
    assert config.pop("experiment") == "cape"
    assert without.pop("experiment") is None
    frequencies, others = config["shape"].pop("frequencies"), without["shape"].pop("frequencies")
    assert frequencies != others
    assert (config["condition"].pop("layer"), without["condition"].pop("layer")) == (0, None if training == "paper" else 2)
    assert config == without  # width, depth, losses and steps are those of the preset, the data is given
    ratios = [b / a for a, b in itertools.pairwise(frequencies)]
    assert len(ratios) > 2
    assert ratios == pytest.approx([2.0] * len(ratios), rel=1e-3)


def test_single_settings_and_other_choices_win(capsys):
    config = composed(capsys, "train", "experiment=cape", "condition.layer=3", "data=clothed", "condition=local")
    assert (config["condition"]["layer"], config["data"]["name"], config["condition"]["name"]) == (3, "clothed", "local")
    config = composed(capsys, "train", "experiment=smoke", "training=standard", "data_root=mine")
    assert config["training"]["name"] == "standard"
    assert config["data_root"] == "mine"


def test_smoke_is_one_small_folder_for_every_command(capsys):
    configs = {name: composed(capsys, name, "experiment=smoke") for name in NAMES}
    assert {config["experiment"] for config in configs.values()} == {"smoke"}
    (root,) = {config["data_root"] for config in configs.values()}
    assert root != composed(capsys, "train")["data_root"]  # full samples are not changed
    assert len({config["output_root"] for name, config in configs.items() if name != "preprocess"}) == 1
    assert configs["train"]["training"]["name"] == "smoke"
    assert configs["train"]["shape"]["name"] == "grid"
    # 240 frames per training sequence: some must remain for training beside those for validation.
    assert 2 <= 240 / configs["preprocess"]["data"]["frame_step"] <= 10


def test_help_lists_them_and_every_one_says_its_name(capsys):
    for name in NAMES:
        command = cli.COMMANDS[name]
        schema = getattr(importlib.import_module(f"snarfcli.commands.{command.module}"), command.schema)
        assert preset_groups(schema, name) == {"experiment": f"experiment/{name}"}
        options = group_options(f"experiment/{name}")
        assert cli.main([name, "--help"]) == 0
        assert f"  experiment            {', '.join(options)}\n" in capsys.readouterr().out
        for option in options:
            assert composed(capsys, name, f"experiment={option}")["experiment"] == option
    assert {folder.name for folder in (config_folder() / "experiment").iterdir()} <= set(cli.COMMANDS)


WRONG = {
    ("train", "experiment=cap"): "there is no experiment=cap; did you mean 'cape'?; choose from cape, smoke, or leave it out",
    ("eval", "experiment=cape"): "there is no experiment=cape; choose from smoke, or leave it out",
    ("train", "experiment.name=cape"): "unknown setting 'experiment.name'; did you mean 'experiment",
    ("doctor", "experiment=smoke"): "unknown setting 'experiment'",
}


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_unknown_ones_are_rejected_in_one_line(capsys, arguments):
    assert cli.main(list(arguments)) == 2
    err = capsys.readouterr().err
    assert WRONG[arguments] in err
    assert len(err.strip().splitlines()) == 1


def test_several_in_one_call(capsys):
    assert cli.main(["train", "-m", "experiment=cape,smok", "data_root=none"]) == 2
    assert "there is no experiment=smok; did you mean 'smoke'?" in capsys.readouterr().err
    assert cli.main(["train", "-m", "experiment=cape,smoke", "data_root=none"]) == 2
    assert capsys.readouterr().err.count("no samples of subject 50002 under none") == 2  # one run of each
