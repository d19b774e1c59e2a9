"""The model card of an avatar."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path

import pytest
import torch
from tiny_avatars import tiny_avatar

from snarfcli.avatar import Avatar
from snarfcli.export.model_card import model_card


def evaluate(run: Path, name: str, **more: object) -> None:
    content = {"frames": 60, "iou_bbox": 0.97981, "iou_surface": 0.93133, "training": tiny_avatar().facts, **more}
    (run / name).mkdir(parents=True, exist_ok=True)
    (run / name / "metrics.json").write_text(json.dumps(content))


def test_it_shows_the_evaluation_of_the_run(tmp_path):
    avatar, run = tiny_avatar(), tmp_path / "run"
    evaluate(run, "eval_id", worst_iou_surface=0.92)
    evaluate(run, "eval_ood")
    avatar.save(run / "avatar.pt")
    Avatar.load(run).save_pretrained(tmp_path / "me")
    card = (tmp_path / "me" / "README.md").read_text(encoding="utf-8")
    assert card.startswith("---\nlicense: cc0-1.0\nlibrary_name: snarf\n")
    assert "# Avatar of tiny\n" in card
    assert "| in distribution | 60 | 98.0 | 93.1 | 92.0 |" in card
    assert "| out of distribution | 60 | 98.0 | 93.1 | – |" in card
    assert "- steps: 10\n" in card
    assert "CC0 1.0" in card
    assert "skeleton of 3 joints" in card


def test_the_example_in_it_runs(tmp_path, monkeypatch):
    tiny_avatar().save_pretrained(tmp_path / "FOLDER")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (tmp_path / "FOLDER/README.md").read_text(encoding="utf-8"), re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert names["inside"].shape == (1, 1000)
    assert names["inside"].dtype == torch.bool


def test_results_of_another_avatar_are_left_out(tmp_path, caplog):
    evaluate(tmp_path, "eval_id", training={"data": "builtin", "subject": "another"})
    (tmp_path / "eval_ood").mkdir()
    (tmp_path / "eval_ood" / "metrics.json").write_text("{")
    with caplog.at_level(logging.WARNING):
        card = model_card(tiny_avatar(), tmp_path, None)
    assert "Not evaluated. IoU bbox in the last validation of the training: 50.0 %." in card
    assert "eval_id/metrics.json: left out of the model card, since it is of another avatar" in caplog.text
    assert "eval_ood/metrics.json: left out of the model card (" in caplog.text


def test_nothing_is_claimed_that_is_not_known():
    avatar = tiny_avatar()
    avatar.facts = {}
    card = model_card(avatar, None, None)
    assert "license: other" in card
    assert "# Avatar of unknown" in card
    assert "Not evaluated.\n" in card
    assert "None is stated" in card
    assert "license: other" in model_card(tiny_avatar(), None, "All rights reserved.")
    assert "\nAll rights reserved.\n" in model_card(tiny_avatar(), None, "All rights reserved.")


HOSTILE = "x\n---\nlicense: mit\n<script>alert(1)</script> [a](javascript:b) ${c} `d`\x1b[2J"


@pytest.mark.parametrize("name", ["subject", "training", "steps", "data", "seed"])
def test_texts_from_files_are_texts(name, tmp_path):
    avatar = tiny_avatar()
    avatar.facts = {**avatar.facts, name: HOSTILE, "validation": {"iou_bbox": HOSTILE}}
    evaluate(tmp_path, "eval_id", training=avatar.facts, frames=HOSTILE, iou_bbox=HOSTILE, iou_surface=True)
    card = model_card(avatar, tmp_path, HOSTILE)
    assert card.count("\n---\n") == 1
    head, _, body = card[4:].partition("\n---\n")
    assert "mit" not in head
    assert not [part for part in ("<script", "](javascript", "\x1b", "${c}", "`d`") if part in body]
    assert re.search(r"\| in distribution \| x &#45;.* \| – \| – \| – \|", body)
