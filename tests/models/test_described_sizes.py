"""A configuration in a file that asks for more than the file holds is an error before anything is built."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
import torch
from fuzzing import peak_memory
from tiny_avatars import KINDS, saved, tiny_avatar

from snarfcli.avatar import Avatar
from snarfcli.errors import UserError


@pytest.mark.parametrize("kind", KINDS)
def test_avatars_of_every_system_are_read_again(kind, tmp_path):
    avatar = tiny_avatar(kind)
    avatar.save(tmp_path / "avatar.pt")
    again = Avatar.load(tmp_path / "avatar.pt")
    points, pose = torch.rand(1, 50, 3) * 0.4 - 0.2, 0.1 * torch.ones(1, 3, 3)
    assert torch.equal(again.occupancy(points, pose), avatar.occupancy(points, pose))
    assert again.to_dict()["config"] == avatar.to_dict()["config"]


HUGE = (
    ("shape", "width", 40_000),
    ("shape", "depth", 10**9),
    ("shape", "condition_size", 10**9),
    ("shape", "feature_cells_m", [0.002]),
    ("shape", "feature_cells_m", [1e-300]),
    ("shape", "frequencies", [1.0] * 50_000),
    ("skinning", "width", 10**8),
    ("skinning", "depth", 10**9),
    ("skinning", "resolution", [1000, 1000, 1000]),
    ("skinning", "resolution", [1, 10**9, 2]),
    ("model", "part_width", 10**5),
    ("model", "part_depth", 10**9),
    ("model", "part_code", 10**9),
    ("condition", "size", 10**9),
)


@pytest.mark.parametrize("kind", ["fast_snarf", "voxel", "preset", "snarf", "back_d", "pose_onet", "nasa"])
def test_huge_sizes_are_refused_without_being_built(kind, tmp_path):
    content = tiny_avatar(kind).to_dict()
    refused, before = 0, peak_memory()
    for group, name, value in HUGE:
        config = {part: dict(settings) for part, settings in content["config"].items()}
        config[group][name] = value
        (tmp_path / "avatar.pt").write_bytes(saved({**content, "config": config}))
        with contextlib.suppress(UserError):
            Avatar.load(tmp_path / "avatar.pt")
            refused -= 1
        refused += 1
    assert peak_memory() - before < 2**27
    assert refused >= 4  # settings of other systems have no effect


def test_numbers_that_are_not_finite_are_named(tmp_path):
    content = tiny_avatar().to_dict()
    name = "shape.layers.1.weight"
    content["state"][name][2, 3] = torch.nan
    (tmp_path / "avatar.pt").write_bytes(saved(content))
    with pytest.raises(UserError, match=rf"state\.{name}: 1 of 48 numbers are NaN or infinite"):
        Avatar.load(tmp_path / "avatar.pt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["grid"].update(lower=torch.tensor([np.nan, 0, 0])), r"grid\.lower: wanted finite numbers"),
        (lambda c: c["skeleton"].update(joints_rest=torch.full((3, 3), np.inf)), r"skeleton\.joints_rest: wanted finite"),
        (lambda c: c["skeleton"].update(parents=[-1, 2, 1]), r"skeleton\.parents: wanted -1 for a root, and parents before"),
        (lambda c: c["skeleton"].update(parents=[-1, 0.0, 1]), r"skeleton\.parents, skeleton\.idle: wanted whole numbers"),
        (lambda c: c["state"].pop("shape.layers.0.bias"), r"Missing key"),
        (lambda c: c["state"].update(more=torch.zeros(2)), r"Unexpected key"),
        (lambda c: c["state"].update({"shape.layers.0.bias": torch.zeros(6).double()}), r"wanted dtype torch.float32"),
        (lambda c: c["state"].update({"deformer.field.prior.owner": torch.tensor([9, 9, 9])}), r"owner: wanted bones from 0"),
        (lambda c: c.update(facts={"subject": torch.zeros(1)}), r"facts\.subject: wanted plain data"),
        (lambda c: c.pop("skeleton"), r"no 'skeleton'"),
    ],
)  # fmt: skip
def test_wrong_content_is_named(change, message, tmp_path):
    content = tiny_avatar().to_dict()
    change(content)
    (tmp_path / "avatar.pt").write_bytes(saved(content))
    with pytest.raises(UserError, match=message) as caught:
        Avatar.load(tmp_path / "avatar.pt")
    assert str(caught.value).isprintable()


def test_rows_of_feature_grids_are_checked(tmp_path):
    content = tiny_avatar("grids").to_dict()
    content["state"]["shape.grids.rows"][0] = -7
    (tmp_path / "avatar.pt").write_bytes(saved(content))
    with pytest.raises(UserError, match="rows: wanted rows from -1, got -7"):
        Avatar.load(tmp_path / "avatar.pt")
