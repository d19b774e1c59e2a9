"""The command line: help, flags, and user errors in one line."""

from __future__ import annotations

import pytest

from snarfcli.cli import main as cli
from snarfcli.cli.flags import translate_flags
from snarfcli.cli.messages import user_message
from snarfcli.errors import UserError
from snarfcli.hydra_config.schema import describe, group_schemas, setting_names

COMMANDS = ("preprocess", "train", "eval", "animate", "export", "doctor", "reproduce")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Run in an empty folder: commands must not depend on the current folder, or leave files there."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(capsys, *arguments):
    """Run the command line in this process; return exit code, standard output and standard error."""
    code = cli.main(arguments)
    out, err = capsys.readouterr()
    return code, out, err


def test_overview_names_every_command(capsys):
    for arguments in ((), ("--help",)):
        code, out, _ = run(capsys, *arguments)
        assert code == 0
        assert all(f"  {name}" in out for name in COMMANDS)
    assert run(capsys, "--version")[1].startswith("snarf 0.")


@pytest.mark.parametrize("name", [*COMMANDS, "evaluate"])
def test_help_shows_purpose_example_choices_and_every_setting(capsys, name):
    code, out, _ = run(capsys, name, "--help")
    command = cli.COMMANDS[name]
    assert code == 0
    assert command.summary in out
    assert command.example in out
    import importlib

    schema = getattr(importlib.import_module(f"snarfcli.commands.{command.module}"), command.schema)
    for setting, text in describe(schema):
        assert text, f"{setting} has no description"
        assert f"  {setting}" in out
    for group, nested in group_schemas(schema).items():
        assert group in out
        assert all(text for _, text in describe(nested))


@pytest.mark.parametrize("name", COMMANDS)
def test_configuration_is_complete_and_typed(capsys, name):
    code, out, err = run(capsys, name, "--cfg", "job")
    assert code == 0, err
    assert "???" not in out


WRONG = {
    ("animate", "--pose", "a.npz", "--pose=b.npz"): "--pose: wanted it once, got it twice",
    ("animate", "--pose", "a.npz", "pose=b.npz"): "--pose and pose=... set the same value",
    ("export", "pose=[b.npz]", "--pose", "a.npz"): "--pose and pose=... set the same value",
    ("eval", "--ood", "split=id"): "--ood and split=... set the same value",
    ("trian",): "unknown command 'trian'; did you mean 'train'?",
    ("train", "subjct=1"): "unknown setting 'subjct'; did you mean 'subject'?",
    ("train", "training.step=3"): "unknown setting 'training.step'; did you mean 'training.steps'?",
    ("train", "+extra=3"): "unknown setting 'extra'",
    ("train", "training=quik"): "there is no training=quik; did you mean 'quick'?; choose from",
    ("train", "search=newton"): "there is no search=newton; choose from broyden, complete",
    ("train", "training.steps=many"): "training.steps: wanted a whole number, got 'many'",
    ("train", "resume=perhaps"): "resume: wanted true or false, got 'perhaps'",
    ("train", "--resum"): "unknown flag '--resum'; did you mean '--resume'?",
    ("train", "~subject"): "wanted a setting NAME=VALUE, got '~subject'",
    ("train", "run=../.."): "run: wanted the name of a folder",
    ("train", "seed=-1"): "seed: wanted at least 0, got -1",
    ("train", "training.validate_every=0"): "training.validate_every: wanted at least 1, got 0",
    ("train", "training.precision=half"): "training.precision: wanted highest, high, medium or bfloat16, got 'half'",
    ("train", "skinning.resolution=[8,8]"): "skinning.resolution: wanted three numbers, along x, y and z, got [8, 8]",
    ("train", "search.jacobian=exat"): "search.jacobian: wanted exact or broyden, got 'exat'; did you mean 'exact'?",
    ("eval", "search=null"): "there is no search=null; choose from broyden, complete, snarf, or leave it out",
    ("train", "50002"): "wanted a setting NAME=VALUE, got '50002'",
    ("train", "subject='unclosed"): 'cannot read "subject=\'unclosed"',
    ("train", "device=gpu"): "device: wanted auto, cpu, cuda or cuda:N, got 'gpu'",
    ("train", "device=cuda:7"): "device: wanted cuda:7, got ",
    ("train", "threads=0", "data_root=none"): "threads: wanted at least 1, got 0",
    ("train",): 'no samples of subject 50002 under data/processed/builtin; run "snarf preprocess',
    ("preprocess", "subject=50003"): "no built-in subject '50003'; did you mean '500",
    ("eval",): 'no avatar in outputs/builtin/50002/fast_snarf; run "snarf train subject=50002" or give ckpt=PATH',
    ("eval", "--ood", "ckpt=none.pt"): "no avatar at none.pt",
    ("eval", "--ood=yes"): "--ood: wanted no value, got '--ood=yes'",
    ("animate",): 'no avatar in outputs/builtin/50002/fast_snarf; run "snarf train subject=50002" or give ckpt=PATH',
    ("animate", "--pose"): "--pose: wanted a value, got none",
}


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_a_user_error_is_one_line_with_code_2(capsys, elsewhere, arguments):
    code, out, err = run(capsys, *arguments)
    assert code == 2
    assert WRONG[arguments] in err
    assert len(err.strip().splitlines()) == 1
    assert "Traceback" not in out + err
    assert not list(elsewhere.iterdir()), "something was left behind"


def test_file_names_with_any_characters_pass_through_flags():
    command = cli.COMMANDS["animate"]
    from hydra.core.override_parser.overrides_parser import OverridesParser

    for name in ("plain.npz", "with space (1)/a=b,c.npz", "it's {odd}$.npz", "back\\slash.npz", "[x]#:y.npz", "trail\\"):
        (override,) = translate_flags(command, ["--pose", name])
        assert OverridesParser.create().parse_override(override).value() == name
        assert translate_flags(command, [f"--pose={name}"]) == [override]


def test_overrides_and_flags_keep_their_order():
    command = cli.COMMANDS["eval"]
    assert translate_flags(command, ["subject=1", "-m", "--ood", "--cfg", "job"]) == [
        "subject=1", "split=ood", "-m", "--cfg", "job",
    ]  # fmt: skip


def test_flags_of_hydra_may_stand_anywhere(capsys):
    code, out, _ = run(capsys, "train", "--cfg", "job", "subject=7", "--package", "training", "training=smoke")
    assert code == 0
    assert "name: smoke" in out
    code, _, err = run(capsys, "preprocess", "-m", "subject=1,2", "workers=1")
    assert code == 2
    assert "no built-in subject '1'" in err


def test_unwritable_and_full_folders_are_named():
    full = OSError(28, "No space left on device", "outputs/x")
    assert "outputs/x: the disk is full" in user_message(full)
    denied = PermissionError(13, "Permission denied", "/locked/x")
    assert "/locked/x: no permission; change its permissions, or name another place (output_root=" in user_message(denied)
    many = OSError(24, "Too many open files", "data/x.npy")
    assert user_message(many) == "data/x.npy: too many open files; raise the limit with `ulimit -n`"
    assert user_message(RuntimeError("a fault of the program")) is None


def test_too_little_memory_is_told():
    told = "not enough memory; close other programs, or choose smaller sizes"
    assert user_message(MemoryError()) == told
    assert user_message(RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 9 bytes")) == told
    own = "not enough memory to read x; close other programs"
    assert user_message(MemoryError(own)) == own


def test_user_error_inside_another_error_is_found():
    error = RuntimeError("outer")
    error.__cause__ = UserError("the reason")
    assert user_message(error) == "the reason"


def test_interrupt_is_130(capsys, monkeypatch):
    monkeypatch.setattr(cli, "_run", lambda command, arguments: (_ for _ in ()).throw(KeyboardInterrupt))
    code, _, err = run(capsys, "train")
    assert code == 130
    assert err.strip() == "snarf train: interrupted"


def test_setting_names_are_dotted():
    from snarfcli.commands.train import TrainConfig

    names = setting_names(TrainConfig)
    assert {"subject", "training", "training.steps", "search.init_bones"} <= set(names)


def test_a_list_needs_no_brackets(capsys):
    for value, wanted in (("front", ["front"]), ("front,left", ["front", "left"]), ("[back]", ["back"])):
        code, out, _ = run(capsys, "animate", f"views={value}", "--cfg", "job")
        assert code == 0
        assert "views:\n" + "".join(f"- {name}\n" for name in wanted) in out
    code, out, _ = run(capsys, "reproduce", "table1", "subjects=50002,50004", "--cfg", "job")
    assert code == 0
    assert "subjects:\n- '50002'\n- '50004'\n" in out


def test_one_value_given_as_a_list_is_told_how_to_write_it(capsys):
    code, _, error = run(capsys, "animate", "motion=[lunges,splits]")
    assert code == 2
    assert error == "snarf animate: motion: wanted one value, got a list; write motion=lunges\n"
