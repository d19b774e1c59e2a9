"""Settings read from the source: the same as those of the imported dataclasses, with almost nothing imported."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from snarfcli.cli.command_list import COMMAND_LIST, Command
from snarfcli.hydra_config.schema import describe, group_schemas
from snarfcli.hydra_config.source_schema import read_schema

HEAVY = ("hydra", "igl", "numpy", "omegaconf", "scipy", "torch", "trimesh")


@pytest.mark.parametrize("command", COMMAND_LIST, ids=lambda command: command.name)
def test_the_source_says_the_same_as_the_class(command: Command):
    module = f"snarfcli.commands.{command.module}"
    schema = getattr(importlib.import_module(module), command.schema)
    read = read_schema(module, command.schema)
    assert list(read.settings().items()) == list(describe(schema))
    assert list(read.groups) == list(group_schemas(schema))
    for name, group in group_schemas(schema).items():
        assert list(read.groups[name].settings().items()) == list(describe(group))


def test_a_class_that_is_not_there_is_named():
    with pytest.raises(LookupError, match=r"snarfcli\.commands\.train has no class TrainConfiguration"):
        read_schema("snarfcli.commands.train", "TrainConfiguration")


def test_help_imports_no_library():
    code = f"""
import sys
from snarfcli.cli.command_list import COMMANDS
from snarfcli.cli.main import main

assert main(["--help"]) == 0
few = len(sys.modules)
assert [main([name, "--help"]) for name in COMMANDS] == [0] * len(COMMANDS)
assert not [name for name in {HEAVY} if name in sys.modules], "imported"
assert not [name for name in sys.modules if name.startswith(("snarfcli.commands", "snarfcli.deformer"))]
assert len(sys.modules) <= few + 15, sorted(sys.modules)
assert few < 250, few
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "training.NAME=VALUE" in done.stdout


def test_the_deformer_imports_pytorch_and_numpy_only():
    code = f"""
import sys
import snarfcli.deformer

assert not [name for name in {HEAVY} if name in sys.modules and name not in ("numpy", "torch")]
assert not [name for name in sys.modules if name.startswith("snarfcli.commands")]
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
