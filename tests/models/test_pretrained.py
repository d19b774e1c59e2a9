"""Avatars as folders that are passed on."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_avatars import KINDS, tiny_avatar

from snarfcli.avatar import Avatar
from snarfcli.errors import UserError
from snarfcli.formats.safetensors import read_safetensors, write_safetensors
from snarfcli.models.trained_field import TrainedField
from snarfcli.runs import find_avatar


@pytest.fixture
def folder(tmp_path) -> Path:
    tiny_avatar().save_pretrained(tmp_path / "me")
    return tmp_path / "me"


def change(folder: Path, **changes: object) -> None:
    """Change values of the configuration."""
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize("kind", KINDS)
def test_every_system_comes_back_bit_for_bit(kind, tmp_path):
    avatar = tiny_avatar(kind)
    avatar.save_pretrained(tmp_path / "me")
    assert sorted(path.name for path in (tmp_path / "me").iterdir()) == ["README.md", "config.json", "model.safetensors"]
    again = Avatar.from_pretrained(tmp_path / "me")
    assert isinstance(again, Avatar)
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1, 300, 3, generator=generator) - torch.tensor([0.5, 0.2, 0.5])
    pose = 0.3 * torch.randn(1, 3, 3, generator=generator)
    assert torch.equal(avatar.occupancy(points, pose), again.occupancy(points, pose))
    if avatar.has_skinning_weights:
        assert torch.equal(avatar.skinning_weights(points[0]), again.skinning_weights(points[0]))
    assert again.config == avatar.config
    assert again.facts == avatar.facts
    assert all(torch.equal(value, again.model.state_dict()[name]) for name, value in avatar.model.state_dict().items())


def test_the_folder_is_one_for_load_and_the_commands_too(folder):
    for place in (folder, folder / "model.safetensors"):
        assert TrainedField.load(place).facts["subject"] == "tiny"
    found = find_avatar("outputs", "builtin", "50002", "x", str(folder))
    assert found == folder / "model.safetensors"
    assert Avatar.load(found).facts["subject"] == "tiny"


def test_numbers_that_json_lacks_are_left_out(tmp_path):
    avatar = tiny_avatar()
    avatar.facts = {"validation": {"iou_bbox": float("nan"), "steps": (1, 2)}}
    avatar.save_pretrained(tmp_path / "me")
    json.loads((tmp_path / "me/config.json").read_text(), parse_constant=pytest.fail)
    assert Avatar.from_pretrained(tmp_path / "me").facts == {"validation": {"iou_bbox": None, "steps": [1, 2]}}


def test_existing_files_are_kept_unless_it_is_wished(folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"config.json exists already; give overwrite=True to replace it, or another folder"):
        tiny_avatar("voxel").save_pretrained(folder)
    assert {name: (folder / name).read_bytes() for name in before} == before
    tiny_avatar("voxel").save_pretrained(folder, overwrite=True)
    assert Avatar.from_pretrained(folder).config.skinning.name == "voxel"
    assert (folder / "notes.txt").read_text() == "mine"
    with pytest.raises(UserError, match=r"notes.txt: wanted a folder, got a file"):
        tiny_avatar().save_pretrained(folder / "notes.txt")


@pytest.mark.parametrize("name", ["config.json", "model.safetensors", "README.md"])
def test_a_folder_that_cannot_be_written_is_as_before(folder, name, monkeypatch):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    write = Path.write_bytes

    def full_disk(path: Path, data: bytes) -> int:
        if path.name.startswith(f".{Path(name).stem}."):
            raise OSError(28, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OSError, match="No space left"):
        tiny_avatar("voxel").save_pretrained(folder, overwrite=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_files_of_two_avatars_are_not_mixed(folder, tmp_path):
    tiny_avatar("voxel").save_pretrained(tmp_path / "other")
    shutil.copy(tmp_path / "other/model.safetensors", folder)
    with pytest.raises(UserError, match=r"model.safetensors is not the file that config.json names \(its checksum differs\)"):
        Avatar.from_pretrained(folder)


def test_what_is_not_the_folder_of_an_avatar(folder, tmp_path):
    with pytest.raises(UserError, match=r"no folder with an avatar at .*none"):
        Avatar.from_pretrained(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"no configuration of the avatar at .*config\.json"):
        Avatar.from_pretrained(tmp_path / "empty")
    change(folder, format="bert")
    with pytest.raises(UserError, match=r"config.json is not a snarf avatar"):
        Avatar.from_pretrained(folder)
    change(folder, format="snarf-avatar", version=99)
    with pytest.raises(UserError, match=r"config.json: wanted format version 1, got 99"):
        Avatar.from_pretrained(folder)
    change(folder, version=1, skeleton=[])
    with pytest.raises(UserError, match=r"config.json does not describe the tensors and the skeleton of an avatar"):
        Avatar.from_pretrained(folder)


def test_tensors_that_do_not_fit_are_one_line(folder):
    arrays, metadata = read_safetensors(folder / "model.safetensors")
    for name, array, message in (
        ("grid.lower", np.zeros(2, np.float32), "grid.lower: wanted shape"),
        ("state.shape.layers.0.weight", arrays["state.shape.layers.0.weight"].astype(np.float64), "wanted dtype torch.float32"),
        ("evil.x", np.zeros(1), "has tensors that are not those of an avatar"),
    ):
        write_safetensors(folder / "model.safetensors", {**arrays, name: array}, metadata)
        digest = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
        change(folder, weights={"sha256": digest})
        with pytest.raises(UserError, match=message) as caught:
            Avatar.from_pretrained(folder)
        assert str(folder) in str(caught.value)
        assert str(caught.value).isprintable()
