"""The command line: help, flags, and user errors in one line."""

from __future__ import annotations

import importlib
import logging
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from snarfcli.cli import main as cli
from snarfcli.cli.flags import translate_flags
from snarfcli.cli.messages import user_message
from snarfcli.commands import doctor
from snarfcli.errors import UserError
from snarfcli.hydra_config.home import expand_home
from snarfcli.hydra_config.overrides import quote_items, readable
from snarfcli.hydra_config.schema import describe, group_schemas, setting_names
from snarfcli.locks import hold_slot
from snarfcli.slots import current_slot, use_slot

COMMANDS = ("preprocess", "train", "eval", "animate", "export", "doctor", "reproduce")
ALL_COMMANDS = ("fit", *COMMANDS)


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
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert all(f"  {name}" in out for name in ALL_COMMANDS)
    assert run(capsys, "--version")[1].startswith("snarf 0.")


@pytest.mark.parametrize("name", [*ALL_COMMANDS, "evaluate"])
def test_help_shows_purpose_example_choices_and_every_setting(capsys, name):
    code, out, _ = run(capsys, name, "--help")
    command = cli.COMMANDS[name]
    assert code == 0
    assert command.summary in out
    assert command.example in out
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
    ("train", "--steps", "100"): "unknown flag '--steps'; settings have no dashes: write training.steps=100; see",
    ("train", "--data-root=a b"): "unknown flag '--data-root=a b'; settings have no dashes: write 'data_root=a b'; see",
    ("export", "--format", "html"): "unknown flag '--format'; settings have no dashes: write format=html; see",
    ("export", "--overwrite", "run=demo"): "unknown flag '--overwrite'; settings have no dashes: write overwrite=VALUE; see",
    ("eval", "ood"): "wanted a setting NAME=VALUE, got 'ood'; write --ood; see",
    ("preprocess", "a b/fox.glb"): "for a rigged file, write data=meshes 'data.folder=a b' subject=fox; see",
    ("preprocess", "data=meshes", "subject=my/fox.glb"): "got the file my/fox.glb; give data.folder=my subject=fox",
    ("train", "~subject"): "wanted a setting NAME=VALUE, got '~subject'",
    ("train", "run=../.."): "run: wanted the name of a folder",
    ("train", "seed=-1"): "seed: wanted at least 0, got -1",
    ("train", "training.validate_every=0"): "training.validate_every: wanted at least 1, got 0",
    ("train", "training.precision=half"): "training.precision: wanted highest, high, medium or bfloat16, got 'half'",
    ("train", "training.graph=yes"): "training.graph: wanted auto, on or off, got 'yes'",
    ("train", "skinning.resolution=[8,8]"): "skinning.resolution: wanted three numbers, along x, y and z, got [8, 8]",
    ("train", "search.jacobian=exat"): "search.jacobian: wanted exact or broyden, got 'exat'; did you mean 'exact'?",
    ("eval", "search=null"): "there is no search=null; choose from broyden, complete, snarf, or leave it out",
    ("train", "50002"): "wanted a setting NAME=VALUE, got '50002'",
    ("train", "subject='unclosed"): 'cannot read "subject=\'unclosed"',
    ("train", "device=gpu"): "device: wanted auto, cpu, cuda or cuda:N, got 'gpu'",
    ("train", "device=cuda:7"): "device: wanted cuda:7, got none, since ",
    ("train", "threads=0", "data_root=none"): "threads: wanted at least 1, got 0",
    ("animate", "motion=lunges,splits"): "motion: wanted one value, got lunges,splits; give -m for one run per value, or",
    ("eval", "output_root=~nobody-has-this-name/o"): "output_root: there is no home folder ~nobody-has-this-name; give the",
    ("eval", "ckpt=${oc.env:HOME"): "missing BRACE_CLOSE",
    ("eval", "ckpt={a.pt}"): "cannot read 'ckpt={a.pt}'",
    ("train",): 'no samples of subject 50002 under data/processed/builtin; run "snarf preprocess',
    ("fit",): "subject: wanted a value, got none; give subject=VALUE",
    ("fit", "subject=me"): "the folder of meshes data/meshes does not exist",
    ("fit", "data=builtin", "subject=50002"): "data: wanted meshes, got builtin, which has poses already",
    ("fit", "subject=me", "cloths=true"): "unknown setting 'cloths'; did you mean 'clothes'",
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


def test_jobs_of_a_multirun_that_run_at_the_same_time_have_different_slots(capsys, elsewhere, monkeypatch):
    slots = []
    monkeypatch.setattr(doctor, "run", lambda config: slots.append(current_slot()))
    assert run(capsys, "doctor", "-m", "subject=1,2")[0] == 0
    with hold_slot(Path("outputs/multirun")):  # of a job in another process
        assert run(capsys, "doctor", "-m", "subject=1,2")[0] == 0
    with use_slot(5):  # given by the user
        assert run(capsys, "doctor")[0] == 0
        assert run(capsys, "doctor", "-m", "subject=1,2")[0] == 0
    assert slots == [0, 0, 1, 1, 5, 5, 5]


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
    for text in ("CUDA out of memory. Tried to allocate 2 GiB", "CUDA error: out of memory\nCUDA", "CUDA: out of memory"):
        assert user_message(RuntimeError(text)).startswith("not enough memory on the GPU; end other programs that use it")
    own = "not enough memory to read x; close other programs"
    assert user_message(MemoryError(own)) == own


def test_user_error_inside_another_error_is_found():
    error = RuntimeError("outer")
    error.__cause__ = UserError("the reason")
    assert user_message(error) == "the reason"


@pytest.mark.parametrize(("number", "wanted"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_requests_to_end_have_exit_codes(capsys, monkeypatch, number, wanted):
    monkeypatch.setattr(cli, "_run", lambda command, arguments: signal.raise_signal(number))
    before = signal.signal(number, signal.default_int_handler)  # ignored where the tests run in the background of a script
    try:
        code, _, err = run(capsys, "train")
    finally:
        signal.signal(number, before)
    assert code == wanted
    assert err.strip() == "snarf train: interrupted"


@pytest.mark.parametrize("streams", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_commands_need_no_open_streams(tmp_path, streams):
    command = f"{shlex.join([sys.executable, '-m', 'snarfcli', 'doctor'])} output_root={shlex.quote(str(tmp_path))} {streams}"
    wrong = command.replace("doctor", "doctr")
    assert subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True).returncode == 0
    assert subprocess.run(wrong, shell=True, cwd=tmp_path, capture_output=True).returncode == 2


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


BARE = (
    "größe", "тест.npz", "模型.pt", "/mnt/Daten (alt)/x", "a~b.pt", r"C:\Users\x y\a.bvh", "it's", 'say "hi"',
    "a@b&c#d!e", "a=b", "[x]#:y", "x[1].npz", "{a}_b", "a^b;c`d`<e>", "c:\\größe\\", "plain", "range of motion(1)",
)  # fmt: skip


@pytest.mark.parametrize("value", BARE)
def test_values_need_no_quotes(value):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    def read(override: str, **more: bool) -> object:
        return OverridesParser.create().parse_override(readable(override, {"pose"}, **more)).value()

    assert read(f"ckpt={value}") == value
    assert read(f"ckpt={value}", is_multirun=True) == value
    assert read(f"pose={value}") == [value]
    assert read(f"pose={value},b.npz") == [value, "b.npz"]
    assert read(f"pose=[{value},b.npz]") == [value, "b.npz"]


def test_a_command_gets_values_without_quotes(capsys):
    code, out, err = run(capsys, "view", "ckpt=~/größe (1).pt", "pose=тест.npz,it's.bvh", "--cfg", "job")
    assert code == 0, err
    config = yaml.safe_load(out)
    assert (config["ckpt"], config["pose"]) == ("~/größe (1).pt", ["тест.npz", "it's.bvh"])


def test_values_that_are_meant_for_hydra_stay_so(capsys):
    lists = {"views"}
    texts = ["b", "null", "'größe'", '"x y"', "[1,2]", "{b:1}", "range(1,3)", "${b.c}/d", "1,2", "'unclosed", "{ö}"]
    for text in [f"a={value}" for value in texts]:
        assert readable(text, lists) == text
    assert readable("a=${b.c}/ö", lists) == "a='${b.c}/ö'"
    assert readable("views=front,ö,'l,m'", lists) == "views=[front,'ö','l,m']"
    assert readable("a=ö,b", lists) == "a='ö,b'"
    assert readable("a=ö,b,'c,d'", lists, is_multirun=True) == "a='ö',b,'c,d'"
    assert readable("views=[ö,b],[c]", lists, is_multirun=True) == "views=['ö',b],[c]"
    assert readable("a=[it's,b]", lists) == "a=['it\\'s',b]"
    assert quote_items("[a.b=it's,c=[8,8]]") == "['a.b=it\\'s','c=[8,8]']"


def test_every_job_of_a_multirun_gets_its_name(capsys):
    code, _, err = run(capsys, "eval", "-m", "run=größe,zweite (neu)")
    assert code == 2
    assert [line.partition(";")[0].rpartition("/")[2] for line in err.splitlines()] == ["größe", "zweite (neu)"]


def test_the_home_folder_is_meant_by_a_tilde(capsys, elsewhere, monkeypatch):
    monkeypatch.setenv("HOME", str(elsewhere / "home"))
    monkeypatch.setenv("USERPROFILE", str(elsewhere / "home"))
    code, _, err = run(capsys, "eval", "output_root=~/o")
    assert code == 2
    assert f"no avatar in {elsewhere / 'home' / 'o'}" in err
    assert f"no avatar at {elsewhere / 'home' / 'a.pt'}" in run(capsys, "eval", "ckpt='~/a.pt'")[2]
    assert str(elsewhere / "home" / "x.bvh") in run(capsys, "doctor", "--pose=~/x.bvh")[2]
    assert run(capsys, "preprocess", "subject=50002", "data_root=~/d", "sequences=[none]")[0] == 2
    assert not (elsewhere / "~").exists()


def test_the_home_folder_is_expanded_in_lists_and_at_the_start_only(monkeypatch):
    monkeypatch.setenv("HOME", "/h")
    monkeypatch.setenv("USERPROFILE", "/h")
    config = importlib.import_module("snarfcli.commands.reproduce").ReproduceConfig(
        what="~", subjects=["~/a", "b~/c", "~d"], extra=["data.folder=~/x"], seeds=[1], report=None
    )
    expanded = expand_home(config)
    home = str(Path("/h"))
    assert (expanded.what, expanded.subjects) == (home, [str(Path("/h/a")), "b~/c", "~d"])
    assert (expanded.extra, expanded.seeds, expanded.report) == (["data.folder=~/x"], [1], None)


def test_reproduce_passes_names_on(capsys, caplog, elsewhere, monkeypatch):
    caplog.set_level(logging.INFO)
    monkeypatch.setenv("HOME", str(elsewhere / "home"))
    monkeypatch.setenv("USERPROFILE", str(elsewhere / "home"))
    code, _, err = run(
        capsys, "reproduce", "table1", "data_root=~/Daten (alt)", "output_root=größe", "--dry-run", "systems=[snarf]",
        "extra=[skinning.weights_file=~/w (1).npz]", "subjects=50002",
    )  # fmt: skip
    assert code == 0, err
    arguments = next(line for line in caplog.messages if "snarf train " in line)
    assert f"data_root='{elsewhere / 'home' / 'Daten (alt)'}'" in arguments
    assert "output_root='größe'" in arguments
    assert not (elsewhere / "~").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full disk to write to")
@pytest.mark.parametrize("arguments", [["--help"], ["doctor", "output_root=none", "data_root=none"]], ids=" ".join)
def test_lost_output_is_an_error(tmp_path, arguments):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "snarfcli", *arguments], stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path
        )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "standard output: No space left on device; " in line


@pytest.mark.skipif(os.name != "posix", reason="pipes of a shell")
def test_a_reader_that_has_seen_enough_is_no_error(tmp_path):
    command = f"{shlex.quote(sys.executable)} -m snarfcli doctor output_root=none | head -n 1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=tmp_path)
    assert (done.stdout, done.stderr) == ("versions\n", "")
