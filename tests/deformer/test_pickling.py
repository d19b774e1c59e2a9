"""A deformer is copied, pickled, saved whole and sent to a process that is spawned, and finds the same there."""

from __future__ import annotations

import copy
import io
import pickle

import pytest
import torch
from skinning_scenes import random_transforms, unit_grid

from snarfcli.deformer import ForwardDeformer, SkinningConfig
from snarfcli.deformer.skinning_config import FIELDS

BONES = 3


def deformer(name, **changes):
    torch.manual_seed(0)
    skinning = SkinningConfig(name=name, resolution=[8, 7, 6], width=16, depth=2, **changes)
    field = None if name != "preset" else torch.nn.Sequential(torch.nn.Linear(3, BONES), torch.nn.Softmax(-1))
    return ForwardDeformer(unit_grid(torch.float32), BONES, skinning, field=field)


def search(module):
    points = torch.rand(2, 20, 3, generator=torch.Generator().manual_seed(2))
    return module(points, random_transforms(2, BONES, 0.3, dtype=torch.float32))


def saved_whole(module):
    buffer = io.BytesIO()
    torch.save(module, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


@pytest.mark.parametrize("again", [copy.deepcopy, lambda module: pickle.loads(pickle.dumps(module)), saved_whole])
@pytest.mark.parametrize("name", FIELDS)
def test_a_copy_finds_the_same(name, again):
    module = deformer(name)
    wanted = search(module)
    for other in (again(module), again(module.freeze())):
        found = search(other)
        assert torch.equal(found.canonical, wanted.canonical)
        assert [key for key, _ in other.named_parameters()] == [key for key, _ in module.named_parameters()]


def search_there(module, results):
    torch.set_num_threads(1)
    found = search(module)
    results.put((found.canonical.tolist(), found.query.tolist()))


def test_a_spawned_process_finds_the_same():
    module = deformer("distilled")
    assert any("original0" in key for key in module.state_dict())
    wanted = search(module)
    processes = torch.multiprocessing.get_context("spawn")
    results = processes.SimpleQueue()
    process = processes.Process(target=search_there, args=(module, results))
    process.start()
    canonical, query = results.get()
    process.join()
    assert process.exitcode == 0
    assert canonical == wanted.canonical.tolist()
    assert query == wanted.query.tolist()
