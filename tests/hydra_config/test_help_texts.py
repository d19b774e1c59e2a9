"""Hydra's parser under the check of help texts that argparse has from Python 3.14 on, also on older Pythons."""

from __future__ import annotations

import argparse

import pytest

from snarfcli.cli.main import main
from snarfcli.commands import doctor
from snarfcli.hydra_config.help_texts import lazy_help_texts


class NoText:
    def __repr__(self) -> str:
        return "made when shown"


@pytest.fixture
def checking(monkeypatch) -> None:
    """Give argparse the check of Python 3.14, if it has none."""
    if hasattr(argparse.ArgumentParser, "_check_help"):
        return

    def check_help(container, action):
        if action.help and hasattr(container, "_get_formatter"):
            try:
                container._get_formatter()._expand_help(action)
            except (ValueError, TypeError, KeyError) as error:
                raise ValueError("badly formed help string") from error

    add_argument = argparse._ActionsContainer.add_argument

    def add_checked(container, *names, **settings):
        action = add_argument(container, *names, **settings)
        container._check_help(action)
        return action

    monkeypatch.setattr(argparse._ActionsContainer, "_check_help", check_help, raising=False)
    monkeypatch.setattr(argparse._ActionsContainer, "add_argument", add_checked)


@pytest.mark.usefixtures("checking")
def test_python_refuses_hydras_parser():
    from hydra._internal.utils import get_args_parser

    with pytest.raises(ValueError, match="badly formed help string"):
        get_args_parser()


@pytest.mark.usefixtures("checking")
def test_every_way_through_hydra_works(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    roots: list[str] = []
    monkeypatch.setattr(doctor, "run", lambda config: roots.append(config.data_root))
    assert main(["doctor", "data_root=a"]) == 0
    assert main(["doctor", "data_root=b,c", "-m"]) == 0
    assert roots == ["a", "b", "c"]
    assert main(["doctor", "--cfg", "job"]) == 0
    assert "data_root: data" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        main(["doctor", "--hydra-help"])
    assert not ended.value.code
    assert "--shell-completion,-sc : Install or Uninstall shell completion" in capsys.readouterr().out


@pytest.mark.usefixtures("checking")
def test_texts_are_still_checked_and_the_check_comes_back():
    with lazy_help_texts():
        parser = argparse.ArgumentParser()
        parser.add_argument("--lazy", help=NoText())  # pyright: ignore[reportArgumentType]
        with pytest.raises(ValueError, match="badly formed help string"):
            parser.add_argument("--wrong", help="100 % of it")
    with pytest.raises(ValueError, match="badly formed help string"):
        argparse.ArgumentParser().add_argument("--lazy", help=NoText())  # pyright: ignore[reportArgumentType]


def test_nothing_changes_without_the_check():
    if hasattr(argparse.ArgumentParser, "_check_help"):
        pytest.skip("this Python has the check")
    with lazy_help_texts():
        assert not hasattr(argparse.ArgumentParser, "_check_help")
