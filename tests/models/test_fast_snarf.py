"""The posed field: composition of correspondences, and avatar files that are none."""

from __future__ import annotations

import pickle

import pytest
import torch
from skinning_scenes import scene, unit_grid

from snarfcli.avatar import Avatar
from snarfcli.deformer import Correspondences, find_correspondences
from snarfcli.errors import UserError
from snarfcli.models.fast_snarf import blend
from snarfcli.models.settings import ModelConfig
from snarfcli.models.system import NO_CORRESPONDENCE
from snarfcli.models.trained_field import FORMAT, FORMAT_VERSION


def correspondences(query, batch, count):
    query = torch.tensor(query)
    total = torch.tensor([len(query)])
    return Correspondences(torch.zeros(len(query), 3), query, torch.zeros(len(query), 3, 3), batch, count, total)


@pytest.mark.parametrize("kind", ["logit", "probability"])
def test_one_correspondence_is_taken_as_it_is(kind):
    found = correspondences([0, 2], 1, 3)
    out = blend(torch.tensor([0.4, -1.5]), found, ModelConfig(blend=kind))
    torch.testing.assert_close(out, torch.tensor([[0.4, NO_CORRESPONDENCE, -1.5]]), atol=1e-5, rtol=1e-5)


def test_blend_lies_between_mean_and_maximum_and_reaches_the_maximum():
    found = correspondences([0, 0, 0], 1, 1)
    logits = torch.tensor([-2.0, 0.5, 3.0])
    means = [float(blend(logits, found, ModelConfig(blend="logit", blend_sharpness=k))) for k in (0.0, 1.0, 50.0)]
    assert means[0] == pytest.approx(0.5)
    assert means[0] < means[1] < means[2]
    assert means[2] == pytest.approx(3.0, abs=1e-4)


def test_probability_blend_is_the_papers_softmax():
    logits = torch.tensor([0.3, -1.0])
    occupancies = logits.sigmoid()
    weights = torch.softmax(5 * occupancies, 0)
    wanted = torch.logit((weights * occupancies).sum())
    out = blend(logits, correspondences([1, 1], 1, 2), ModelConfig(blend="probability", blend_sharpness=5.0))
    assert float(out[0, 1]) == pytest.approx(float(wanted), abs=1e-5)


def test_blend_gives_every_correspondence_a_gradient():
    logits = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64, requires_grad=True)
    found = correspondences([0, 0, 1], 1, 2)
    for kind in ("logit", "probability"):
        config = ModelConfig(blend=kind, blend_sharpness=2.0)
        assert torch.autograd.gradcheck(lambda x, config=config: blend(x, found, config), logits)
        (gradient,) = torch.autograd.grad(blend(logits, found, config).sum(), logits)
        assert bool((gradient != 0).all())


@pytest.mark.parametrize("kind", ["logit", "probability"])
def test_rows_beyond_the_roots_change_nothing(kind):
    """As a search with a capacity returns them: their query is B * N, and they get no gradient."""
    points, transforms, weights = scene(torch.float64, count=30)
    config = ModelConfig(blend=kind, blend_sharpness=5.0)
    free = find_correspondences(points, transforms, weights, unit_grid())
    padded = find_correspondences(points, transforms, weights, unit_grid(), capacity=len(free.query) + 9)
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(len(free.query), dtype=torch.float64, generator=generator).requires_grad_()
    more = torch.cat([logits.detach(), torch.full((9,), 1e4, dtype=torch.float64)]).requires_grad_()
    wanted, found = blend(logits, free, config), blend(more, padded, config)
    assert torch.equal(found, wanted)
    (expected,), (gradient,) = (torch.autograd.grad(out.sin().sum(), x) for out, x in ((wanted, logits), (found, more)))
    assert torch.equal(gradient[:-9], expected)
    assert not gradient[-9:].any()


class Bomb:
    """Leaves a mark if it is ever unpickled."""

    def __reduce__(self):
        return (exec, ("import snarfcli; snarfcli.EXPLODED = True",))


def bad_files(folder):
    """Return files that are no avatar, with what the message must say."""
    (folder / "empty.pt").touch()
    (folder / "text.pt").write_text("not an avatar")
    torch.save({"format": FORMAT, "version": FORMAT_VERSION, "config": {}}, folder / "hollow.pt")
    torch.save({"format": FORMAT, "version": 99}, folder / "newer.pt")
    torch.save([1, 2, 3], folder / "list.pt")
    torch.save({"weights": torch.zeros(3)}, folder / "other.pt")
    torch.save(Bomb(), folder / "bomb.pt")
    (folder / "raw.pt").write_bytes(pickle.dumps(Bomb()))
    whole = (folder / "hollow.pt").read_bytes()
    (folder / "cut.pt").write_bytes(whole[: len(whole) // 2])
    damaged = "is not a file of PyTorch, or is cut off"
    return {
        "missing": "no avatar at", "empty": damaged, "text": damaged, "cut": damaged, "raw": damaged,
        "bomb": "asks for __builtin__.exec, which plain data does not need; nothing was executed",
        "hollow": "does not describe an avatar of this version", "newer": "wanted format version 1, got 99",
        "list": "is not a snarf avatar", "other": "is not a snarf avatar",
    }  # fmt: skip


def test_files_that_are_no_avatar_end_in_one_line(tmp_path):
    import snarfcli

    for name, message in bad_files(tmp_path).items():
        with pytest.raises(UserError, match=message) as caught:
            Avatar.load(tmp_path / f"{name}.pt")
        assert "\n" not in str(caught.value)
    assert not hasattr(snarfcli, "EXPLODED")
