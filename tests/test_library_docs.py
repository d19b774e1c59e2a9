"""The pages for users of the library: their programs run, their functions are right, and what they name exists."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from documents import python_examples, run_examples
from torch import Tensor, nn
from torch.nn import functional as F

import snarfcli
import snarfcli.deformer
from snarfcli import ForwardDeformer, builtin_body

DOCS = Path(__file__).parents[1] / "docs"
LIBRARY, FAST_SNARF = DOCS / "library.md", DOCS / "from_fast_snarf.md"
OFFSET, SCALE = torch.tensor([[[0.0, 0.35, -0.1]]]), torch.tensor([[[0.9, 0.9, 3.6]]])  # of a box, as Fast-SNARF keeps it


@pytest.fixture(scope="module")
def library() -> dict[str, Any]:
    torch.manual_seed(0)
    return run_examples(LIBRARY, python_examples(LIBRARY))


@pytest.fixture(scope="module")
def fast_snarf() -> dict[str, Any]:
    torch.manual_seed(0)
    return run_examples(FAST_SNARF, python_examples(FAST_SNARF))


def test_the_program_of_the_library_page_runs(library):
    assert len(python_examples(LIBRARY)) == 8
    assert library["colour"].shape == (2, 985, 3)
    assert library["matrices"].shape == (2, 985, 4, 4)
    assert library["normal"].norm(dim=1).allclose(torch.ones(len(library["normal"])))
    assert float(library["pose"].grad.norm()) > 0
    found = library["found"]  # of the map with an offset, at the vertices
    assert found.count == 6890
    assert float(found.found.float().mean()) > 0.99


def test_normals_moved_by_the_inverse_jacobian_are_those_of_skin(library):
    """As the page says of `posed.skin(x, normals=gradient)`."""
    found = library["deformer"](library["vertices"][:, ::50], library["bone_transforms"])
    rows = found.argmax(torch.ones(len(found.canonical)))
    x, inverse = (found.gather(part, rows, 0.0) for part in (found.canonical, found.jacobian_inverse))
    gradient = torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    posed = library["deformer"].pose(library["bone_transforms"])
    _, normals = posed.skin(x, normals=gradient)
    expected = F.normalize((inverse * gradient[..., None]).sum(2), dim=2)
    assert float((normals - expected)[rows >= 0].abs().max()) < 1e-3


def test_the_programs_of_the_fast_snarf_page_run(fast_snarf):
    assert fast_snarf["inside"].shape == fast_snarf["logits"].shape == (2, 1000)
    assert fast_snarf["xc"].shape[:3] == fast_snarf["valid_ids"].shape == fast_snarf["J_inv"].shape[:3]
    for name in ("like_fast_snarf", "like_snarf"):
        found = fast_snarf[name](fast_snarf["xd"][:1, :300], fast_snarf["tfs"][:1])
        assert len(found.canonical) > 30


def normalised_points(count: int) -> tuple[Tensor, Tensor]:
    """Return points of the box in Fast-SNARF's coordinates, -1 to 1, and in metres, [N, 3] each."""
    normalised = 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 1
    return normalised, normalised / SCALE[0, 0] - OFFSET[0, 0]


def test_fixed_weights_are_moved_as_they_are(fast_snarf):
    weights = torch.randn(1, 24, 4, 16, 16, generator=torch.Generator().manual_seed(0)).softmax(1)
    deformer = fast_snarf["from_preset"](weights, OFFSET, SCALE)
    normalised, points = normalised_points(200)
    expected = F.grid_sample(weights, normalised[None, :, None, None], align_corners=True)[0, :, :, 0, 0].T
    assert float((deformer.skinning_weights(points) - expected).abs().max()) < 1e-4


def test_trained_weights_are_moved_as_logits(fast_snarf):
    logits = torch.randn(1, 24, 4, 16, 16, generator=torch.Generator().manual_seed(0))
    deformer = fast_snarf["from_voxel"](logits, OFFSET, SCALE)
    normalised, points = normalised_points(200)
    weights = (20 * logits).softmax(1)
    expected = F.grid_sample(weights, normalised[None, :, None, None], align_corners=True)[0, :, :, 0, 0].T
    assert float((deformer.skinning_weights(points).detach() - expected).abs().max()) < 1e-4
    deformer(points[None], torch.eye(4).expand(1, 24, 4, 4)).canonical.sum().backward()
    assert deformer.field.logits.grad is not None


class WeightNetwork(nn.Module):
    """A network that is called as theirs is."""

    def __init__(self) -> None:
        super().__init__()
        self.lin0 = nn.Linear(3, 24)

    def forward(self, x: Tensor, cond: dict[str, Tensor], mask: Tensor | None = None) -> Tensor:
        assert x.ndim == 3
        return self.lin0(x)


def test_a_network_is_moved_with_its_names(fast_snarf):
    torch.manual_seed(0)
    before = nn.ModuleDict({"deformer": nn.ModuleDict({"lbs_network": WeightNetwork()})})
    deformer = fast_snarf["from_network"](WeightNetwork(), fast_snarf["grid"])
    after = nn.ModuleDict({"deformer": deformer})
    state = {
        name.replace("deformer.lbs_network.", "deformer.field.lbs_network."): value
        for name, value in before.state_dict().items()
    }
    result = after.load_state_dict(state, strict=False)
    assert not result.unexpected_keys
    assert sorted(result.missing_keys) == ["deformer.active_cells", "deformer.lower", "deformer.upper"]
    nodes = fast_snarf["grid"].nodes(deformer.shape)[5, 5, :3]
    with torch.no_grad():
        expected = (20 * before["deformer"]["lbs_network"](nodes[None], {}, None)[0]).softmax(1)
        assert float((deformer.skinning_weights(nodes) - expected).abs().max()) < 1e-5


@pytest.mark.parametrize("page", [LIBRARY, FAST_SNARF], ids=lambda page: page.stem)
def test_what_a_page_names_exists(page):
    text = page.read_text()
    deformer = ForwardDeformer.from_body(builtin_body(), resolution=[12, 12, 6])
    posed = deformer.pose(torch.eye(4).expand(1, 24, 4, 4))
    known = {"deformer": deformer, "posed": posed, "found": posed(torch.zeros(1, 1, 3)), "ForwardDeformer": ForwardDeformer}
    theirs = {"forward", "lbs_network"}  # of Fast-SNARF's deformer
    named = set(re.findall(r"\b(deformer|posed|found|ForwardDeformer)\.(\w+)", text))
    assert len(named) > 12
    assert {(owner, name) for owner, name in named if not hasattr(known[owner], name) and name not in theirs} == set()
    functions = set(re.findall(r"`(find_\w+|blended_matrices|inverse_skin|[A-Z]\w+Config)\(?", text))
    assert functions
    assert {name for name in functions if not hasattr(snarfcli.deformer, name) and not hasattr(snarfcli, name)} == set()
