"""Questions about trees of joints that are given by the parent of each joint."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["common_ancestor", "path_up"]


def path_up(joint: int, parents: Sequence[int]) -> list[int]:
    """Return the joint, its parent, and so on up to the root; empty if the joint is -1."""
    path = []
    while joint >= 0:
        path.append(joint)
        joint = parents[joint]
    return path


def common_ancestor(first: int, second: int, parents: Sequence[int]) -> int:
    """Return the lowest joint that has both joints below it or is one of them; -1 if they have different roots."""
    above = set(path_up(first, parents))
    return next((joint for joint in path_up(second, parents) if joint in above), -1)
