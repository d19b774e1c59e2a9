"""Scenes to compare correspondence searches: weight fields, poses, queries and a canonical shape for each."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from snarfcli.bodies import axis_angle_to_matrix
from snarfcli.bodies.extent import weight_segments
from snarfcli.datasets.builtin import builtin_subject
from snarfcli.datasets.subjects import SubjectData
from snarfcli.deformer import CanonicalGrid
from snarfcli.motions import builtin_motion
from snarfcli.sampling import sampling_cube, winding_numbers
from snarfcli.segments import segment_distances

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "deformer"))
import itertools

from ground_truth import blended_nodes, field, locate_cells

__all__ = ["NINE_BONES", "QUERY_KINDS", "Scene", "body_scene", "field_scene", "scenes"]

NINE_BONES = (0, 1, 2, 4, 5, 16, 17, 18, 19)
"""The released start bones: pelvis, hips, knees, shoulders, elbows."""
QUERY_KINDS = ("cube", "half near")
"""`cube`: uniform in the papers' cube. `half near`: half uniform, half within 1 cm (standard deviation) of the surface."""

_MARGIN_M = (0.12, 0.12, 0.20)  # as conf/skinning/distilled.yaml
_NEAR_M = 0.02  # cells this near to the body are active
_SUBJECT = "50002"


@dataclass(frozen=True, eq=False)
class Scene:
    """One weight field in one pose, with a canonical shape."""

    name: str
    """Field and pose."""
    weights: Tensor
    """Skinning weights at the nodes, [D, H, W, J], float32."""
    transforms: Tensor
    """Bone transforms of the pose, [J, 4, 4], canonical to posed, float32."""
    grid: CanonicalGrid
    """The nodes' box."""
    near_cells: Tensor
    """Cells within 2 cm of the canonical shape, bool [D-1, H-1, W-1]."""
    surface: np.ndarray
    """Points on the canonical surface, [S, 3], metres."""
    occupied: Callable[[np.ndarray], np.ndarray]
    """Whether canonical points [N, 3] are inside the canonical shape, bool [N]."""
    init_bones: tuple[int, ...]
    """Start bones: nine, or all of a smaller skeleton."""
    mesh: tuple[np.ndarray, np.ndarray] | None = None
    """Vertices [V, 3], metres, and faces of the canonical shape, where it is a mesh."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes (D, H, W)."""
        depth, height, width = self.weights.shape[:3]
        return depth, height, width

    def posed(self, canonical: np.ndarray) -> np.ndarray:
        """Skin canonical points [N, 3] of the grid into posed space, float64."""
        lower, upper = self.grid.lower.double().numpy(), self.grid.upper.double().numpy()
        nodes = blended_nodes(self.weights.numpy(), self.transforms.numpy())
        return field(nodes, self.shape, lower, upper, *locate_cells(canonical, self.shape, lower, upper))[0]

    def queries(self, kind: str, count: int, seed: int = 0) -> Tensor:
        """Return `count` queries [N, 3], float32, posed space; see `QUERY_KINDS`."""
        generator = np.random.default_rng(seed)
        surface = self.posed(self.surface)
        lower, side = sampling_cube(surface)
        uniform = count if kind == "cube" else count // 2
        points = lower + generator.random((uniform, 3)) * side
        near = surface[generator.integers(0, len(surface), count - uniform)]
        near = near + generator.normal(0, 0.01, near.shape)
        points = generator.permutation(np.concatenate([points, near]))
        return torch.as_tensor(points, dtype=torch.float32)


def scenes(quick: bool = False) -> list[Scene]:
    """Return all scenes, from mild to extreme; with `quick` a few of them."""
    body = [
        body_scene("running_on_spot"),
        body_scene("knees"),
        body_scene("punching"),
        body_scene("deep_squats"),
        body_scene("splits"),
        body_scene("arms_behind_back"),
        body_scene("sits_and_twists"),
        body_scene("random joints"),
    ]
    others = [
        field_scene(2, (9, 7, 5), 1.0),
        field_scene(24, (33, 17, 12), 1.0),
        field_scene(55, (33, 17, 12), 1.2),
        body_scene("knees", "distances to bones, 1 cm", (32, 32, 8)),
        body_scene("arms_behind_back", "distances to bones, 1 cm", (32, 32, 8)),
        body_scene("punching", "untrained network, sharpness 20"),
    ]
    return [body[2], body[5], body[7], others[1], others[4]] if quick else body + others


@lru_cache(maxsize=1)
def _subject() -> SubjectData:
    return builtin_subject(_SUBJECT)


@lru_cache(maxsize=1)
def _canonical_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [V, 3], float64, and faces of the built-in subject in the canonical pose."""
    template = _subject().template
    return template.vertices, template.faces


@lru_cache(maxsize=8)
def _body_field(kind: str, resolution: tuple[int, int, int]) -> tuple[CanonicalGrid, Tensor]:
    """Return the grid and the weights of one field around the body; resolution along x, y, z."""
    vertices, _ = _canonical_mesh()
    grid = CanonicalGrid.around(torch.as_tensor(vertices, dtype=torch.float32), _MARGIN_M)
    shape = (resolution[2], resolution[1], resolution[0])
    nodes = grid.nodes(shape).reshape(-1, 3)
    if kind == "body's weights":
        weights = _diffused(vertices, _subject().template.weights.astype(np.float64), nodes.double().numpy(), shape)
    elif kind == "distances to bones, 1 cm":
        segments, owner = weight_segments(_subject().skeleton)
        distance = torch.full((len(nodes), 24), torch.inf)
        distance = distance.scatter_reduce(
            1, torch.tensor(owner).expand(len(nodes), -1), segment_distances(nodes, segments), "amin"
        )
        weights = torch.softmax(-distance / 0.01, -1).numpy()
    else:
        weights = _untrained((nodes - (grid.lower + grid.upper) / 2) / ((grid.upper - grid.lower) / 2), 24, 20.0).numpy()
    return grid, torch.as_tensor(weights, dtype=torch.float32).reshape(*shape, -1)


def _diffused(vertices: np.ndarray, weights: np.ndarray, nodes: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Spread vertex weights [V, J] to the nodes [D * H * W, 3]: nearest vertices, then smoothing away from the surface."""
    distance, nearest = cKDTree(vertices).query(nodes, 16)
    share = 1 / (distance + 1e-3) ** 2
    values = (share[..., None] * weights[nearest]).sum(1) / share.sum(1)[:, None]
    values = values.reshape(*shape, -1)
    free = (distance[:, 0] > 0.05).reshape(shape)[..., None]
    for _ in range(30):
        padded = np.pad(values, [(1, 1)] * 3 + [(0, 0)], mode="edge")
        around = [np.roll(padded, step, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for step in (-1, 1)]
        values = np.where(free, sum(around) / 6, values)
    return (values / values.sum(-1, keepdims=True)).reshape(-1, weights.shape[1])


def _untrained(nodes: Tensor, bones: int, sharpness: float) -> Tensor:
    """Return the softmax [N, J] of a freshly initialised network of the papers' size at nodes [N, 3] in [-1, 1]."""
    generator = torch.Generator().manual_seed(0)
    h, sizes = nodes, [3, 128, 128, 128, 128, bones]
    for i, (wide, narrow) in enumerate(itertools.pairwise(sizes)):
        weight, bias = (torch.rand(narrow, k, generator=generator) * 2 - 1 for k in (wide, 1))
        h = h @ (weight / wide**0.5).T + bias[:, 0] / wide**0.5  # PyTorch's default for linear layers
        h = torch.nn.functional.softplus(h, beta=100) if i < 4 else h
    # A little more than a fresh network's spread, so that several bones win somewhere.
    return torch.softmax(sharpness * 20 * (h - h.mean(0)), -1)


def _pose(name: str) -> Tensor:
    """Return the pose [24, 3] of a built-in motion with the strongest bends, or a pose with random joints."""
    if name == "random joints":
        generator = torch.Generator().manual_seed(1)
        return 0.7 * torch.randn(24, 3, generator=generator)
    poses = builtin_motion(name, int(_SUBJECT)).poses
    return torch.as_tensor(poses[np.linalg.norm(poses[:, 1:], axis=2).sum(1).argmax()], dtype=torch.float32)


def _surface_points(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Return points [count, 3] spread evenly over a mesh."""
    generator = np.random.default_rng(0)
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = generator.choice(len(faces), count, p=areas / areas.sum())
    root, second = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
    a, b, c = corners[chosen].transpose(1, 0, 2)
    return (1 - root) * a + root * (1 - second) * b + root * second * c


def body_scene(pose: str, kind: str = "body's weights", resolution: tuple[int, int, int] = (64, 64, 16)) -> Scene:
    """Return the built-in subject 50002 in one pose.

    Args:
        pose: a built-in motion, or "random joints".
        kind: "body's weights" (its own, spread into the grid), "distances to bones, 1 cm", or anything else for an
            untrained network.
        resolution: nodes along x, y, z.
    """
    vertices, faces = _canonical_mesh()
    grid, weights = _body_field(kind, resolution)
    transforms = _subject().skeleton.posed_from_canonical(_pose(pose)[None])[0]
    size = "x".join(map(str, resolution))
    return Scene(
        f"{pose} ({kind}, {size}, 24 bones)",
        weights,
        transforms,
        grid,
        _near_cells(grid, (resolution[2], resolution[1], resolution[0])),
        _surface_points(vertices, faces, 50_000),
        lambda points: winding_numbers(vertices, faces, points) > 0.5,
        NINE_BONES,
        (vertices, faces),
    )


@lru_cache(maxsize=8)
def _near_cells_at(lower: tuple, upper: tuple, shape: tuple[int, int, int]) -> Tensor:
    vertices, faces = _canonical_mesh()
    fine = tuple(2 * n - 1 for n in shape)  # corners, middles of edges and faces, centres
    points = CanonicalGrid(torch.tensor(lower), torch.tensor(upper)).nodes(fine).reshape(-1, 3).double().numpy()
    near = cKDTree(_surface_points(vertices, faces, 200_000)).query(points, distance_upper_bound=_NEAR_M)[0] < _NEAR_M
    near |= winding_numbers(vertices, faces, points) > 0.5
    return torch.nn.functional.max_pool3d(torch.as_tensor(near).reshape(1, 1, *fine).float(), 3, stride=2)[0, 0] > 0


def _near_cells(grid: CanonicalGrid, shape: tuple[int, int, int]) -> Tensor:
    """Return the cells within 2 cm of the body, bool [D-1, H-1, W-1]."""
    return _near_cells_at(tuple(grid.lower.tolist()), tuple(grid.upper.tolist()), shape)


def field_scene(bones: int, resolution: tuple[int, int, int], angle: float, seed: int = 0) -> Scene:
    """Return a smooth random field with bones that turn about their own centres, and a ball as the shape.

    Args:
        bones: J.
        resolution: nodes along x, y, z.
        angle: standard deviation of each component of the bones' rotations, radians.
        seed: of all random numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    grid = CanonicalGrid(torch.tensor([-1.0, -0.9, -1.1]), torch.tensor([1.0, 1.1, 0.9]))
    middle, radius = torch.tensor([0.0, 0.1, -0.1]), 0.7
    shape = (resolution[2], resolution[1], resolution[0])
    centres = middle + 1.6 * torch.rand(bones, 3, generator=generator) - 0.8
    distance = (grid.nodes(shape)[..., None, :] - centres).norm(dim=-1)
    weights = torch.softmax(-8 * distance, -1)
    turn = axis_angle_to_matrix(angle * torch.randn(bones, 3, generator=generator))
    transforms = torch.eye(4).repeat(bones, 1, 1)
    transforms[:, :3, :3] = turn
    shift = 0.05 * torch.randn(bones, 3, generator=generator)
    transforms[:, :3, 3] = centres - (turn @ centres[:, :, None])[:, :, 0] + shift
    directions = np.random.default_rng(seed).normal(size=(20_000, 3))
    centre = middle.double().numpy()
    surface = centre + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    fine = tuple(2 * n - 1 for n in shape)
    inside = (grid.nodes(fine) - middle).norm(dim=-1) < radius + _NEAR_M
    near = torch.nn.functional.max_pool3d(inside[None, None].float(), 3, stride=2)[0, 0] > 0
    return Scene(
        f"random field, turns of {angle} rad ({'x'.join(map(str, resolution))}, {bones} bones)",
        weights,
        transforms,
        grid,
        near,
        surface,
        lambda points: np.linalg.norm(points - centre, axis=1) < radius,
        tuple(range(min(9, bones))),
    )
