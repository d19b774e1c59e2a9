"""Softmaxes from a network's logits to skinning weights: over all bones, or down the tree of joints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["SOFTMAXES", "HierarchicalSoftmax", "PlainSoftmax", "make_softmax"]

_LOWEST_LOG = -1e4  # stands for the logarithm of a weight of zero


class PlainSoftmax(nn.Module):
    """Softmax with one logit per bone.

    Source: SNARF Sec. 3.1, which makes weights non-negative and sum to 1 "using a softmax activation function" and names no
    other; the released settings use it too.
    """

    def __init__(self, num_bones: int) -> None:
        super().__init__()
        self.num_bones = num_bones
        self.num_logits = num_bones
        """Logits of a point."""

    def forward(self, logits: Tensor) -> Tensor:
        """Return weights [..., J] from logits [..., num_logits]; they sum to 1."""
        return torch.softmax(logits, -1)

    def invert(self, log_weights: Tensor) -> Tensor:
        """Return logits [..., num_logits] whose weights are the softmax of `log_weights` [..., J]."""
        return log_weights


class HierarchicalSoftmax(nn.Module):
    """Weights as probabilities of a walk down the tree of joints: choose a root, then at each joint stop or go on to a child.

    The weight of a joint is the probability that the walk stops there, so all weights sum to 1. Two branches compete only where
    they part: a foot takes nothing directly from a hand, for any logits. The papers describe the plain softmax only (SNARF
    Sec. 3.1); this one is an alternative to it.

    A joint with siblings has one logit against them (several roots are siblings), and a joint with children has one for
    stopping; `num_logits` is the number of both, 25 for the 24 joints of SMPL. The logits of the first kind come first, each
    kind in the order of the joints. All is computed as sums of logarithms, so that long chains and large logits neither
    overflow nor lose their gradients.

    Args:
        parents: parent of each of the J joints, negative for a root; in any order, with any number of roots.

    Raises:
        ValueError: `parents` is empty, names a joint that does not exist, or contains a cycle.
    """

    _choice: Tensor
    _stop: Tensor
    _go: Tensor
    _members: Tensor
    _strides: Tensor

    def __init__(self, parents: Sequence[int]) -> None:
        super().__init__()
        parents = [int(parent) for parent in parents]
        depths = _depths(parents)
        self.num_bones = len(parents)
        children: dict[int, list[int]] = {}
        for joint, parent in enumerate(parents):
            children.setdefault(max(parent, -1), []).append(joint)
        contested = sorted(joint for group in children.values() if len(group) > 1 for joint in group)
        inner = sorted(joint for joint in children if joint >= 0)
        self.num_logits = len(contested) + len(inner)
        """Logits of a point."""
        self._children = children
        self._bottom_up = sorted(range(len(parents)), key=lambda joint: -depths[joint])
        self._contested, self._inner = contested, inner
        self._groups = [group for group in children.values() if len(group) > 1]

        # Columns of [0, the values of all groups]; column 0 stands for a joint without siblings.
        order = [joint for group in self._groups for joint in group]
        choice = [1 + order.index(joint) if joint in order else 0 for joint in range(len(parents))]
        # Columns of [0, the inner joints' values]; column 0 stands for a last joint, or for the level above a root.
        stop = [1 + inner.index(joint) if joint in inner else 0 for joint in range(len(parents))]
        go = [stop[parent] if parent >= 0 else 0 for parent in parents]
        members = [contested.index(joint) for joint in order]
        # Sums along the path from the root by doubling the stride; the place J holds a zero for the level above the roots.
        up = torch.tensor([parent if parent >= 0 else len(parents) for parent in parents] + [len(parents)])
        strides = []
        for _ in range(max(depths).bit_length()):
            strides.append(up)
            up = up[up]
        tables = {"choice": choice, "stop": stop, "go": go, "members": members}
        for name, table in tables.items():
            self.register_buffer(f"_{name}", torch.tensor(table, dtype=torch.long), persistent=False)
        self.register_buffer("_strides", torch.stack(strides) if strides else up[None][:0], persistent=False)

    def log_weights(self, logits: Tensor) -> Tensor:
        """Return the logarithms of the weights [..., J] from logits [..., num_logits]."""
        zero = logits.new_zeros(*logits.shape[:-1], 1)
        against, stopping = logits.split([len(self._contested), len(self._inner)], -1)
        sizes = [len(group) for group in self._groups]
        choices = [part.log_softmax(-1) for part in against[..., self._members].split(sizes, -1)] if sizes else []
        choice = torch.cat([zero, *choices], -1)[..., self._choice]
        stop = torch.cat([zero, F.logsigmoid(stopping)], -1)[..., self._stop]
        go = torch.cat([zero, F.logsigmoid(-stopping)], -1)[..., self._go]
        reached = torch.cat([choice + go, zero], -1)
        for stride in self._strides:
            reached = reached + reached[..., stride]
        return reached[..., :-1] + stop

    def forward(self, logits: Tensor) -> Tensor:
        """Return weights [..., J] from logits [..., num_logits]; they sum to 1."""
        return self.log_weights(logits).exp()

    def invert(self, log_weights: Tensor) -> Tensor:
        """Return logits [..., num_logits] whose weights are the softmax of `log_weights` [..., J]."""
        branch = {joint: log_weights[..., joint].clamp_min(_LOWEST_LOG) for joint in self._bottom_up}
        stopping = {}
        for joint in self._bottom_up:  # the children come before their parent
            if joint in self._children:
                below = torch.stack([branch[child] for child in self._children[joint]], -1).logsumexp(-1)
                stopping[joint] = branch[joint] - below
                branch[joint] = torch.logaddexp(branch[joint], below)
        columns = [branch[joint] for joint in self._contested] + [stopping[joint] for joint in self._inner]
        return torch.stack(columns, -1) if columns else log_weights[..., :0]


SOFTMAXES = ("plain", "hierarchical")
"""Names of the softmaxes."""


def make_softmax(name: str, num_bones: int, parents: Sequence[int] | None = None) -> PlainSoftmax | HierarchicalSoftmax:
    """Return the softmax of one of the names in `SOFTMAXES`.

    Args:
        name: plain, or hierarchical, which needs `parents`.
        num_bones: J.
        parents: parent of each bone, negative for a root.

    Raises:
        ValueError: unknown name, or parents are missing, do not fit or do not form a tree.
    """
    if name not in SOFTMAXES:
        raise ValueError(f"skinning.softmax: wanted {' or '.join(SOFTMAXES)}, got {name!r}")
    if name == "plain" or num_bones == 1:  # with one bone a hierarchy has no logits
        return PlainSoftmax(num_bones)
    if parents is None:
        raise ValueError("parents: wanted the parent of each bone for skinning.softmax 'hierarchical', got None")
    if len(parents) != num_bones:
        raise ValueError(f"parents: wanted one for each of the {num_bones} bones, got {len(parents)}")
    return HierarchicalSoftmax(parents)


def _depths(parents: list[int]) -> list[int]:
    """Return the number of steps from each joint up to its root."""
    if not parents:
        raise ValueError("parents: wanted at least one joint, got none")
    depths = []
    for joint, parent in enumerate(parents):
        depth, above = 0, parent
        while above >= 0:
            if above >= len(parents):
                raise ValueError(f"parents: wanted numbers below {len(parents)}, got {above}")
            depth += 1
            if depth >= len(parents):
                raise ValueError(f"parents: wanted a tree, got a cycle at or above joint {joint}")
            above = parents[above]
        depths.append(depth)
    return depths
