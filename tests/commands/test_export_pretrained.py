"""`snarf export format=pretrained`: the avatar as a folder, whose model card has the numbers of its evaluation."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest
import torch
from tiny_avatars import tiny_avatar

from snarfcli.avatar import Avatar
from snarfcli.cli.main import main

RUN = Path("outputs/builtin/tiny/fast_snarf")
FOLDER = RUN / "export/tiny_pretrained"
FILES = ["README.md", "config.json", "model.safetensors"]


@pytest.fixture(autouse=True)
def trained(tmp_path, monkeypatch) -> Avatar:
    """Return an avatar in a run folder below the current folder, with one evaluation."""
    monkeypatch.chdir(tmp_path)
    avatar = tiny_avatar()
    avatar.save(RUN / "avatar.pt")
    (RUN / "eval_id").mkdir()
    content = {"frames": 60, "iou_bbox": 0.97981, "iou_surface": 0.93133, "training": avatar.facts}
    (RUN / "eval_id/metrics.json").write_text(json.dumps(content))
    return avatar


def export(capsys, *arguments: str) -> tuple[int, str]:
    code = main(["export", "subject=tiny", "device=cpu", "format=pretrained", f"ckpt={RUN}", *arguments])
    return code, capsys.readouterr().err


def card() -> str:
    return (FOLDER / "README.md").read_text("utf-8")


def test_the_folder_has_the_avatar_and_its_evaluation(trained, capsys, caplog):
    with caplog.at_level(logging.INFO):
        assert export(capsys) == (0, "")
    assert sorted(path.name for path in FOLDER.iterdir()) == FILES
    assert "| in distribution | 60 | 98.0 | 93.1 |" in card()
    assert "the model card contains the IoU in distribution" in caplog.text
    pose, points = torch.zeros(1, 3, 3), torch.rand(1, 200, 3) * 2 - 1
    again = Avatar.from_pretrained(FOLDER)
    torch.testing.assert_close(again.occupancy(points, pose), trained.occupancy(points, pose), rtol=0, atol=0)
    record = json.loads(FOLDER.with_name("tiny_pretrained.json").read_text())
    assert record["complete"]
    assert record["evaluations"] == ["in distribution"]
    assert record["bytes"] == sum(path.stat().st_size for path in FOLDER.iterdir())


def test_nothing_in_it_names_a_path_of_this_machine(capsys, tmp_path):
    assert export(capsys)[0] == 0
    for name in FILES:
        content = (FOLDER / name).read_bytes()
        assert str(tmp_path).encode() not in content
        assert b"outputs" not in content


def test_without_an_evaluation_it_says_how_to_get_one(capsys, caplog):
    (RUN / "eval_id/metrics.json").write_text("{}")
    with caplog.at_level(logging.INFO):
        assert export(capsys, "pretrained.license=Ask me first.")[0] == 0
    assert 'no evaluation: run "snarf eval" and "snarf eval --ood" first' in caplog.text
    assert caplog.text.count("since it is of another avatar") == 1
    assert "Not evaluated." in card()
    assert "Ask me first." in card()


def test_existing_folders_are_replaced_on_request_only(capsys):
    assert export(capsys)[0] == 0
    code, err = export(capsys)
    assert code == 2
    assert "already; give overwrite=true to replace it, or output=FOLDER" in err
    assert export(capsys, "overwrite=true")[0] == 0
    (FOLDER / "notes.txt").write_text("mine")
    code, err = export(capsys, "overwrite=true")
    assert code == 2
    assert "wanted only files of such an export, got notes.txt" in err
    assert (FOLDER / "notes.txt").read_text() == "mine"


def test_what_a_killed_export_has_left_is_replaced(capsys):
    assert export(capsys)[0] == 0
    FOLDER.with_name("tiny_pretrained.json").write_text(json.dumps({"complete": False}))
    left = FOLDER.with_name(".tiny_pretrained.0123abcd.tmp")
    left.mkdir()
    assert export(capsys)[0] == 0
    assert not left.exists()
    assert json.loads(FOLDER.with_name("tiny_pretrained.json").read_text())["complete"]


def test_motions_are_not_used(capsys, caplog):
    assert export(capsys, "motion=lunges")[0] == 0
    assert "not used with format=pretrained" in caplog.text


def test_a_failed_export_leaves_no_folder(capsys, monkeypatch):
    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Avatar, "save_pretrained", fail)
    code, err = export(capsys)
    assert code == 2
    assert "the disk is full" in err
    assert not FOLDER.exists()
    assert not FOLDER.with_name("tiny_pretrained.json").exists()
