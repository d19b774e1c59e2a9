"""Choose the joints of a limb among candidates: the cheapest that follow each other from parent to child."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from snarfcli.motions.trees import path_up

__all__ = ["best_chain"]

_NOT_BELOW = 3.0  # cost of a joint that is not below the one before, as between two rigs in one file
_MAX_CANDIDATES = 16  # per part; a rig with helpers has about six
Candidates = Mapping[int, float]


def best_chain(candidates: Mapping[str, Candidates], without: Mapping[str, float], parents: Sequence[int]) -> dict[str, int]:
    """Return the cheapest joints of a limb, each for one part; parts may stay without a joint.

    The cost is the sum of those of the chosen joints, of the parts without a joint, and of joints that are not below the one
    chosen before: names decide where the tree is flat.

    Args:
        candidates: per part from the trunk outwards, {joint: cost}.
        without: cost per part of having no joint.
        parents: J parents, -1 for a root.
    """
    # by the last chosen joint, -1 for none: the cost so far and the joints of the parts
    chains: dict[int, tuple[float, dict[str, int]]] = {-1: (0.0, {})}
    for part, joints in candidates.items():
        longer = {last: (cost + without[part], chain) for last, (cost, chain) in chains.items()}
        for joint in sorted(joints, key=lambda joint: (joints[joint], joint))[:_MAX_CANDIDATES]:
            above = set(path_up(joint, parents))
            for last, (cost, chain) in chains.items():
                total = cost + joints[joint] + (_NOT_BELOW if last >= 0 and last not in above else 0.0)
                if joint not in chain.values() and (joint not in longer or total < longer[joint][0]):
                    longer[joint] = total, {**chain, part: joint}
        chains = longer
    return min(chains.values(), key=lambda entry: entry[0])[1]
