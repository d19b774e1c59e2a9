"""Which functions of canonical points take the pose, and how they are called."""

from __future__ import annotations

from functools import partial, wraps

import pytest
import torch
from torch import Tensor, nn

from snarfcli.deformer.callables import takes_pose, with_pose


class Posed(nn.Module):
    def forward(self, x: Tensor, pose_index: Tensor) -> Tensor:
        return x * pose_index[:, None]


class Plain(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return 2 * x


class Called:
    def __call__(self, x, *, pose_index):
        return x * pose_index[:, None]

    def method(self, x, sharpness=1.0, pose_index=None):
        return x * pose_index[:, None] * sharpness


def posed(x: Tensor, pose_index: Tensor) -> Tensor:
    return x * pose_index[:, None]


def plain(x: Tensor) -> Tensor:
    return 2 * x


def decorated(function):
    @wraps(function)
    def inner(*arguments, **named):
        return function(*arguments, **named)

    return inner


X, INDEX = torch.ones(2, 3), torch.tensor([1, 3])

POSED = {
    "function": lambda: posed,
    "decorated": lambda: decorated(posed),
    "lambda": lambda: lambda x, pose_index: posed(x, pose_index),
    "by position only": lambda: lambda x, pose_index, /: posed(x, pose_index),
    "module": Posed,
    "object": Called,
    "method": lambda: Called().method,
    "partial": lambda: partial(Called().method, sharpness=1.0),
    "partial of a module": lambda: partial(Posed()),
    "partial that binds another": lambda: partial(lambda scale, x, pose_index: scale * posed(x, pose_index), 1.0),
    "compiled module": lambda: torch.compile(Posed(), backend="eager"),
    "compiled in place": lambda: (lambda module: module.compile(backend="eager") or module)(Posed()),
    "compiled function": lambda: torch.compile(posed, backend="eager"),
    "scripted module": lambda: torch.jit.script(Posed()),
    "scripted function": lambda: torch.jit.script(posed),
    "traced module": lambda: torch.jit.trace(Posed(), (X, INDEX)),
    "exported": lambda: torch.export.export(Posed(), (X, INDEX)).module(),
    "vmap": lambda: torch.vmap(lambda x, pose_index: x * pose_index),
    "wrapped for several devices": lambda: nn.DataParallel(Posed()),
}
PLAIN = {
    "function": lambda: plain,
    "any arguments": lambda: lambda *arguments, **named: plain(*arguments, **named),
    "module": Plain,
    "sequence": lambda: nn.Sequential(Plain()),
    "compiled module": lambda: torch.compile(Plain(), backend="eager"),
    "scripted module": lambda: torch.jit.script(Plain()),
    "built in": lambda: X.new_tensor(2.0).mul,
    "bound pose": lambda: partial(posed, pose_index=torch.tensor([2, 2])),
    "bound pose of a module": lambda: partial(Posed(), pose_index=torch.tensor([2, 2])),
}
pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")


@pytest.mark.parametrize("name", POSED)
def test_functions_that_take_the_pose(name):
    function = POSED[name]()
    assert takes_pose(function)
    assert torch.equal(with_pose(function)(X, INDEX), posed(X, INDEX))


@pytest.mark.parametrize("name", PLAIN)
def test_functions_that_do_not(name):
    function = PLAIN[name]()
    assert not takes_pose(function)
    assert torch.equal(with_pose(function)(X, INDEX), 2 * X)
