"""Compare the configuration in an avatar's file with the numbers that the file holds, before anything is built.

A few bytes of configuration can ask for gigabytes. The networks, grids and tables of a system are all part of its state, so a
configuration that asks for more numbers than the state in the file has cannot belong to it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

from torch import Tensor

from snarfcli.deformer import CanonicalGrid
from snarfcli.models.settings import AvatarConfig
from snarfcli.shape.features import grid_nodes

__all__ = ["check_described_sizes"]

_POINTWISE = ("pose_onet", "back_lbs", "back_d", "smpl_nn")
_PARTS = ("nasa", "piecewise")
_MOST_NODE_WEIGHTS = 2**26  # numbers at the nodes of a weight grid; 65,536 nodes of 1000 joints


def check_described_sizes(config: AvatarConfig, num_joints: int, grid: CanonicalGrid, state: Mapping[str, Tensor]) -> None:
    """Check that a model can be built from a configuration without more memory than its state justifies.

    Args:
        config: architecture.
        num_joints: J.
        grid: canonical box.
        state: tensors of the file by name.

    Raises:
        ValueError: a size is out of range, or the configuration asks for more numbers than the file holds.
    """
    _check_ranges(config, len(state))
    name = config.model.name
    asked = _part_numbers(config, num_joints) if name in _PARTS else _shape_numbers(config, num_joints, grid)
    if name not in (*_POINTWISE, *_PARTS):
        asked += _field_numbers(config, num_joints)
    elif name in ("back_lbs", "back_d"):
        outputs = 3 if name == "back_d" else 1
        asked += _layers([3 + 3 * (num_joints - 1)] + [config.skinning.width] * config.skinning.depth + [outputs])
    held = sum(tensor.numel() for tensor in state.values())
    if asked > held:
        raise ValueError(f"config: asks for at least {asked:,} numbers, and the file holds {held:,}")


def _check_ranges(config: AvatarConfig, tensors: int) -> None:
    """Check the sizes by themselves. A layer has at least two of the tensors of the file."""
    shape, skinning, model, condition = config.shape, config.skinning, config.model, config.condition
    for name, value, least, most in (
        ("shape.width", shape.width, 1, math.inf),
        ("shape.depth", shape.depth, 1, tensors if model.name not in _PARTS else math.inf),
        ("shape.condition_size", shape.condition_size, 1, math.inf),
        ("condition.size", 1 if condition.size is None else condition.size, 1, math.inf),
        ("shape.features", shape.features, 1, 16),
        ("skinning.width", skinning.width, 1, math.inf),
        ("skinning.depth", skinning.depth, 0, math.inf),
        ("model.part_width", model.part_width, 1, math.inf),
        ("model.part_depth", model.part_depth, 1, tensors if model.name in _PARTS else math.inf),
        ("model.part_code", model.part_code, 0, math.inf),
    ):
        if not least <= value <= most:
            wanted = f"{least} to {most}" if most < math.inf else f"at least {least}"
            raise ValueError(f"config.{name}: wanted {wanted}, got {value}")
    if len(skinning.resolution) != 3 or min(skinning.resolution) < 2:
        raise ValueError(f"config.skinning.resolution: wanted three numbers of at least 2, got {skinning.resolution[:9]}")
    if (
        skinning.depth > tensors
        and model.name not in (*_PARTS, "pose_onet", "smpl_nn")
        and skinning.name in ("distilled", "mlp")
    ):
        raise ValueError(f"config.skinning.depth: wanted at most {tensors}, got {skinning.depth}")


def _layers(sizes: list[int]) -> int:
    """Return the number of weights of layers from each size to the next."""
    return sum(a * b for a, b in itertools.pairwise(sizes))


def _shape_numbers(config: AvatarConfig, num_joints: int, grid: CanonicalGrid) -> int:
    """Return at least how many numbers the canonical shape has: its layers, and the tables of its feature grids."""
    shape, is_posed = config.shape, config.model.name == "pose_onet"
    cells = [] if is_posed else shape.feature_cells_m
    nodes = sum(math.prod(part) for part in grid_nodes(grid.lower, grid.upper, cells))
    point = 3 + 6 * len(shape.frequencies) + shape.features * len(cells)
    asked = _layers([point] + [shape.width] * shape.depth + [1])
    asked += sum(point * shape.width for index in set(shape.skip_layers) if 0 < index < shape.depth)
    pose = 3 * (num_joints - 1)
    if is_posed:
        asked += pose * pose  # its code has the size of the pose
    elif config.condition.name != "none" and (shape.condition_layer is not None or config.condition.layer is not None):
        asked += pose * (shape.condition_size if config.condition.size is None else config.condition.size)
    covered = shape.features * nodes if config.model.name in _POINTWISE else 0  # elsewhere only where the body may be
    return asked + nodes + covered


def _field_numbers(config: AvatarConfig, num_joints: int) -> int:
    """Return at least how many numbers forward skinning has: cells of the grid, and the weights or the network that gives them.

    Raises:
        ValueError: the grid has too many weights, which are evaluated from the network.
    """
    skinning = config.skinning
    nodes = math.prod(skinning.resolution)
    weights = nodes * num_joints
    if weights > _MOST_NODE_WEIGHTS:
        raise ValueError(
            f"config.skinning.resolution: wanted at most {_MOST_NODE_WEIGHTS:,} weights at the nodes, got {weights:,}"
        )
    asked = math.prod(side - 1 for side in skinning.resolution)
    if config.model.name == "snarf" or skinning.name in ("distilled", "mlp"):
        return asked + _layers([3] + [skinning.width] * skinning.depth + [1])
    if skinning.name == "preset":
        return asked + weights
    # of a symmetric field one half is optimised; a hierarchy of joints has at least half as many logits as joints
    return asked + weights // 4


def _part_numbers(config: AvatarConfig, num_joints: int) -> int:
    """Return at least how many numbers the networks of the parts have."""
    model = config.model
    code = 0 if model.name == "piecewise" else model.part_code
    each = _layers([3 + code] + [model.part_width] * model.part_depth + [1])
    return num_joints * (each + 3 * num_joints * code)
