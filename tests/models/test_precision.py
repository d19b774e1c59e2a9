"""The precision of an avatar's shape network: chosen for the avatar or for one query, and handed down to the network."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from snarfcli import Avatar
from snarfcli.models.system import System


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return Avatar.load(Path(__file__).parents[1] / "golden" / "avatar.pt")


@pytest.fixture
def asked(monkeypatch) -> list[str]:
    """The precisions in which the network is evaluated."""
    seen: list[str] = []
    original = System.canonical_logits

    def noting(self, canonical, condition, pose, precision="highest", weights=None):
        seen.append(precision)
        return original(self, canonical, condition, pose, precision, weights)

    monkeypatch.setattr(System, "canonical_logits", noting)
    return seen


def query(avatar: Avatar, **precision: str):
    pose = torch.zeros(1, avatar.skeleton.num_joints, 3)
    return avatar.query(avatar.skeleton.canonical_joints[None], avatar.bone_transforms(pose), pose, **precision)


def test_float32_is_the_default(avatar, asked):
    query(avatar)
    assert avatar.precision == "highest"
    assert asked == ["highest"]


def test_a_query_may_choose_another(avatar, asked):
    query(avatar, precision="high")
    assert asked == ["high"]


def test_an_avatar_with_a_precision_uses_it_everywhere(avatar, asked):
    faster = avatar.with_precision("bfloat16")
    assert faster.model is avatar.model
    pose = torch.zeros(1, avatar.skeleton.num_joints, 3)
    calls = [
        lambda: query(faster),
        lambda: faster.occupancy(avatar.skeleton.canonical_joints[None], pose),
        lambda: faster.canonical_logits(avatar.skeleton.canonical_joints, pose[0]),
        lambda: faster.mesh(pose, resolution=16),
        lambda: faster.mesh(pose, resolution=16, surface="skinned"),
    ]
    for call in calls:
        asked.clear()
        call()
        assert asked[-1] == "bfloat16"  # the box of the body, which all copies share, is found in float32
    query(faster, precision="highest")
    assert asked[-1] == "highest"
    assert avatar.precision == "highest"


@pytest.mark.skipif(torch.cuda.is_available(), reason="on a GPU the precision has an effect")
def test_it_has_no_effect_on_a_cpu(avatar):
    assert torch.equal(query(avatar).logits, query(avatar.with_precision("bfloat16")).logits)


def test_unknown_precisions_are_named(avatar):
    for wrong in (avatar.with_precision, lambda name: query(avatar, precision=name)):
        with pytest.raises(ValueError, match=r"precision: wanted one of highest, high, medium, bfloat16, got 'half'"):
            wrong("half")
