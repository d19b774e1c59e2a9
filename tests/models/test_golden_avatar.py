"""An avatar that an earlier version trained and saved gives the numbers that it gave then."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from snarfcli import Avatar

FOLDER = Path(__file__).parents[1] / "golden"


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return Avatar.load(FOLDER / "avatar.pt")  # snarf train training=smoke, with networks of 16


@pytest.fixture(scope="module")
def golden() -> dict:
    return json.loads((FOLDER / "avatar.json").read_text())


def volume(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def test_the_posed_field_is_the_same(avatar, golden):
    points, pose = torch.tensor(golden["points"]), torch.tensor(golden["pose"])
    found = avatar.query(points, avatar.bone_transforms(pose), pose)
    assert found.counts.tolist() == golden["roots"]
    assert found.counts.max() > 1
    # float32 with other orders of sums than on the machine of the golden numbers; logits reach 10
    torch.testing.assert_close(found.logits, torch.tensor(golden["logits"]), rtol=1e-4, atol=1e-3)


def test_surfaces_and_weights_are_the_same(avatar, golden):
    pose = torch.tensor(golden["pose"])[0]
    for surface in ("field", "skinned"):
        mesh = avatar.mesh(pose, resolution=48, surface=surface)
        assert volume(mesh) == pytest.approx(golden[f"{surface}_volume_m3"], rel=1e-4)
    weights = avatar.skinning_weights(avatar.skeleton.canonical_joints)
    torch.testing.assert_close(weights, torch.tensor(golden["weights_at_joints"]), rtol=1e-4, atol=1e-5)


def test_saved_again_it_has_the_same_content(avatar, tmp_path):
    avatar.save(tmp_path / "again.pt")
    before, after = (torch.load(path, weights_only=True) for path in (FOLDER / "avatar.pt", tmp_path / "again.pt"))
    states = before.pop("state"), after.pop("state")
    grids = before.pop("grid"), after.pop("grid")
    skeletons = before.pop("skeleton"), after.pop("skeleton")
    configs = before.pop("config"), after.pop("config")
    for group, settings in configs[0].items():  # later versions may have more settings
        assert settings == {name: configs[1][group][name] for name in settings}
    assert before == after
    for one, other in (states, grids, skeletons):
        assert one.keys() == other.keys()
        for name, value in one.items():
            assert torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]
