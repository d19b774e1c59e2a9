"""The forward-skinning module: takes posed points, returns their canonical correspondences under a weight field."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from snarfcli.deformer.canonical_body import CanonicalBody, canonical_body, weights_around
from snarfcli.deformer.cells import corners_of
from snarfcli.deformer.complete import posed_cell_boxes
from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.field_search import find_correspondences_on_field
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate
from snarfcli.deformer.grid_search import check_transforms, find_correspondences
from snarfcli.deformer.hierarchy import make_softmax
from snarfcli.deformer.search_config import SearchConfig, as_search_config
from snarfcli.deformer.skinning import blend_transforms, interpolate, skin
from snarfcli.deformer.skinning_config import FIELDS, SkinningConfig
from snarfcli.deformer.variation import total_variation
from snarfcli.deformer.weights import (
    BonePrior,
    GridWeights,
    NetworkWeights,
    NodeWeights,
    VoxelWeights,
    WeightField,
)

__all__ = ["ForwardDeformer"]

_VALUES_AT_ONCE = 2**24  # of a layer, at the nodes; 65,536 nodes with layers of 256


class ForwardDeformer(nn.Module):
    """Find the canonical correspondences of posed points under learned forward skinning.

    Args:
        grid: canonical box of the weight grid.
        num_bones: J, the number of bone transforms.
        skinning: the weight field.
        search: how correspondences are found; weights that are searched directly (skinning.name "mlp") need "broyden".
        active_cells: [D-1, H-1, W-1], bool, the cells that a complete search looks into (see `cells_near`); None for all.
        prior: weights that the field only corrects.
        parents: parent of each bone, negative for a root; for skinning.softmax "hierarchical".
        field: a custom weight field instead of the one that `skinning` describes: a module or function from canonical
            points [N, 3], metres, to weights [N, J], rows sum to 1. It is evaluated at the grid nodes, or searched directly if
            skinning.name is "mlp". A module is trained, moved and saved with the deformer.
        mirror: the bone to which each is mapped by the symmetry of voxel weights, see `VoxelWeights`; None for none.

    Raises:
        ValueError: a setting does not exist, or does not fit the others.
    """

    lower: Tensor
    upper: Tensor
    active_cells: Tensor
    """[D-1, H-1, W-1], bool, the cells that a complete search looks into; see `set_active_cells`."""
    _used_nodes: Tensor
    _active_nodes: Tensor
    _active_points: Tensor
    field: Callable[[Tensor], Tensor]
    body: CanonicalBody | None = None
    """The body that the deformer was made for by `from_body`; not part of the state."""

    def __init__(
        self,
        grid: CanonicalGrid,
        num_bones: int,
        skinning: SkinningConfig | None = None,
        search: SearchConfig | str | None = None,
        active_cells: Tensor | None = None,
        prior: BonePrior | None = None,
        *,
        parents: Sequence[int] | None = None,
        field: Callable[[Tensor], Tensor] | None = None,
        mirror: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        skinning = skinning or SkinningConfig()
        if skinning.name not in FIELDS:
            raise ValueError(f"skinning.name: wanted {', '.join(FIELDS[:-1])} or {FIELDS[-1]}, got {skinning.name!r}")
        width, height, depth = skinning.resolution
        self.shape = (depth, height, width)
        self.num_bones = num_bones
        self.searches_field = skinning.name == "mlp"
        """Whether roots are those of the field itself and not of its values at the grid nodes."""
        self.search = as_search_config(search or ("broyden" if self.searches_field else None))
        self.field = field if field is not None else _make_field(grid, self.shape, num_bones, skinning, prior, parents, mirror)
        if isinstance(self.field, GridWeights) and self.field.shape != self.shape:
            raise ValueError(f"field: wanted the grid's nodes {list(self.shape)} (z, y, x), got {list(self.field.shape)}")
        self.register_buffer("lower", grid.lower.clone())
        self.register_buffer("upper", grid.upper.clone())
        self.register_buffer("active_cells", torch.ones([n - 1 for n in self.shape], dtype=torch.bool))
        self.register_buffer("_used_nodes", torch.empty(0, dtype=torch.bool), persistent=False)
        self.register_buffer("_active_nodes", torch.empty(0, dtype=torch.long), persistent=False)
        self.register_buffer("_active_points", torch.empty(0, 3), persistent=False)
        self.set_active_cells(self.active_cells if active_cells is None else active_cells)
        self._frozen: Tensor | None = None
        self.register_load_state_dict_post_hook(_after_load)

    @classmethod
    def from_body(
        cls,
        body: object,
        *,
        betas: Tensor | Sequence[float] | None = None,
        canonical_pose: Tensor | None = None,
        resolution: Sequence[int] | None = None,
        margin_m: Sequence[float] | None = None,
        search: SearchConfig | str | None = None,
        trainable: bool = False,
    ) -> ForwardDeformer:
        """Make a deformer for a body, with the body's weights. `deformer.body` has its canonical vertices and skeleton.

        `deformer.body.posed_from_canonical(pose)` returns the bone transforms that the deformer takes. The box lies around the
        body in the canonical pose, the cells near it are searched, and the weights are extended from the vertices to the grid.

        Args:
            body: path of a file in SMPL's format; a `Body`; or a mapping or an object with vertices [V, 3] (or v_template),
                weights [V, J] (or lbs_weights), joints [J, 3] (or J_regressor [J, V]) and parents [J] (or kintree_table), such
                as a model of the package smplx. Pose correctives are not used.
            betas: [S], shape parameters, for a body that has shape directions.
            canonical_pose: [J, 3], axis-angle relative to the body's rest pose, radians; None: the rest pose, with the legs 30
                degrees outwards if the joints are SMPL's or named l_hip and r_hip.
            resolution: grid nodes along x, y, z; None for as many as in `SkinningConfig`, distributed by the sides of the box.
            margin_m: margin of the box along x, y, z, metres; None for those of `SkinningConfig` in proportion to the body.
            search: as for the class.
            trainable: whether the weights are trained, from those of the body on, as voxel weights.

        Raises:
            ValueError: an array is missing, or a shape, a number or a parent is not valid.
            UserError: the file cannot be read.
        """
        content = canonical_body(body, betas=betas, canonical_pose=canonical_pose, resolution=resolution, margin_m=margin_m)
        field = weights_around(content, trainable)
        skinning = SkinningConfig(name="voxel" if trainable else "preset", resolution=list(content.shape[::-1]))
        deformer = cls(content.grid, content.skeleton.num_joints, skinning, search, content.active_cells, field=field)
        deformer.body = content
        return deformer

    @property
    def search(self) -> SearchConfig:
        """How correspondences are found."""
        return self._search

    @search.setter
    def search(self, search: SearchConfig) -> None:
        if self.searches_field and search.name != "broyden":
            raise ValueError(
                f"search.name: wanted broyden for skinning.name 'mlp', got {search.name!r}: the field has no cells"
            )
        self._search = search

    @property
    def grid(self) -> CanonicalGrid:
        """The box of the weight grid."""
        return CanonicalGrid(self.lower, self.upper, checked=True)

    # ---------------------------------------------------------------- weights
    def weight_grid(self, active_only: bool = False) -> Tensor:
        """Return the skinning weights at the grid nodes, [D, H, W, J].

        With `active_only` only the nodes of active cells are evaluated, which are all that a complete search reads; the others
        are zero. Nothing in it waits for a GPU.
        """
        if self._frozen is not None:
            return self._frozen
        if not active_only:
            return self._weights_of_nodes(None).reshape(*self.shape, -1)
        used = self._active_nodes
        weights = self._weights_of_nodes(used)
        return weights.new_zeros(math.prod(self.shape), self.num_bones).index_copy(0, used, weights).reshape(*self.shape, -1)

    def _weights_of_nodes(self, nodes: Tensor | None) -> Tensor:
        """Return the weights [K, J] at the active nodes, given as `nodes`, or at all nodes if None."""
        count = math.prod(self.shape) if nodes is None else len(nodes)
        if isinstance(self.field, GridWeights):
            return self._checked(self.field.at_nodes(nodes), count)
        points = self.grid.nodes(self.shape).reshape(-1, 3) if nodes is None else self._active_points
        # not a subclass, whose `forward` may be another one
        if type(self.field) is not NetworkWeights:
            return self._checked(self.field(points), count)
        most = count if torch.is_grad_enabled() else max(1, _VALUES_AT_ONCE // self.field.most_values)
        if count <= most:
            return self._checked(self.field.at_fixed_points(points), count)
        return self._checked(torch.cat([self.field.at_fixed_points(part) for part in points.split(most)]), count)

    def node_weights(self, active_only: bool | None = None) -> NodeWeights | None:
        """Evaluate the skinning weights at the nodes that a search reads; None for a field that is searched directly.

        A search and `skinning_weights` take the result, so that the field is evaluated once for both.

        Args:
            active_only: whether only nodes of active cells are evaluated; None: as the search needs it.
        """
        if self.searches_field:
            return None
        return self._node_weights(self.search.name == "complete" if active_only is None else active_only)

    def _node_weights(self, active_only: bool) -> NodeWeights:
        with torch.autocast(self.lower.device.type, enabled=False):
            return NodeWeights(self.weight_grid(active_only), self.grid)

    def skinning_weights(self, canonical: Tensor, weights: NodeWeights | None = None) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3], as the search uses them.

        Args:
            canonical: [N, 3], metres.
            weights: from `node_weights`, if they have been evaluated already; the points must then lie in active cells.
        """
        if self.searches_field:
            return self._checked(self.field(canonical), len(canonical))
        return interpolate(self.weight_grid() if weights is None else weights.values, canonical, self.grid)

    def _checked(self, weights: Tensor, count: int) -> Tensor:
        """Return the weights of a field, or raise ValueError if their shape is wrong."""
        if tuple(weights.shape) != (count, self.num_bones):
            raise ValueError(f"field: wanted weights of shape [{count}, {self.num_bones}], got {list(weights.shape)}")
        return weights

    def freeze(self) -> ForwardDeformer:
        """Evaluate the weight grid once and keep it; for use after training. `train()` discards it."""
        self.eval()
        self._frozen = None
        with torch.no_grad():
            self._frozen = self.weight_grid()
        return self

    def train(self, mode: bool = True) -> ForwardDeformer:
        """Switch between training and evaluation; both discard a frozen weight grid."""
        self._frozen = None
        return super().train(mode)

    def _apply(self, fn, recurse=True):
        self._frozen = None
        return super()._apply(fn, recurse)

    # ---------------------------------------------------------------- search
    def forward(
        self, points: Tensor, bone_transforms: Tensor, capacity: int | None = None, weights: NodeWeights | None = None
    ) -> Correspondences:
        """Find the correspondences of posed points, in full precision, also under autocast.

        Args:
            points: [B, N, 3], posed space, metres.
            bone_transforms: [B, J, 4, 4], canonical to posed.
            capacity: as in `find_correspondences`; not for a field that is searched directly.
            weights: from `node_weights`, if they have been evaluated already.
        """
        with torch.autocast(points.device.type, enabled=False):
            if self.searches_field:
                if capacity is not None:
                    raise ValueError(
                        "capacity: wanted None for a field that is searched directly; it needs a search on the grid"
                    )
                return find_correspondences_on_field(points, bone_transforms, self.field, self.grid, search=self.search)
            complete = self.search.name == "complete"
            weights = self._node_weights(active_only=complete) if weights is None else weights
            sums_to_one = isinstance(self.field, WeightField)
            if sums_to_one:
                check_transforms(bone_transforms)
            return find_correspondences(
                points,
                bone_transforms,
                weights.values,
                self.grid,
                search=self.search,
                active_cells=self.active_cells if complete else None,
                capacity=capacity,
                check=not sums_to_one,
            )

    def set_active_cells(self, cells: Tensor) -> None:
        """Choose the cells that a complete search looks into, [D-1, H-1, W-1], bool; they are saved with the state.

        Waits for a GPU, so that a search need not.

        Raises:
            ValueError: the shape or dtype differs, or no cell is left.
        """
        wanted = [n - 1 for n in self.shape]
        if list(cells.shape) != wanted or cells.dtype != torch.bool:
            raise ValueError(f"active_cells: wanted bool {wanted}, got {cells.dtype} {list(cells.shape)}")
        if not bool(cells.any()):
            raise ValueError("active_cells: wanted at least one cell, got none")
        self.active_cells.copy_(cells)
        self._update_active_nodes()

    def _update_active_nodes(self) -> None:
        """Keep which nodes active cells have, flat indices [K] and positions [K, 3]: finding them waits for a GPU."""
        self._used_nodes = corners_of(self.active_cells)
        self._active_nodes = self._used_nodes.reshape(-1).nonzero()[:, 0]
        self._active_points = self.grid.nodes(self.shape).reshape(-1, 3)[self._active_nodes]

    def is_active(self, canonical: Tensor) -> Tensor:
        """Return whether canonical points [N, 3] lie in cells that a complete search looks into, [N], bool."""
        cell, local = locate(canonical, self.grid, self.shape)
        return ((local >= 0) & (local <= 1)).all(1) & self.active_cells.reshape(-1)[cell]

    def posed_box(self, bone_transforms: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of a box around the images of `cells` in one pose, metres.

        It bounds the field that is trilinear between the nodes. A field that is searched directly may exceed it slightly.

        Args:
            bone_transforms: [J, 4, 4], canonical to posed.
            cells: [D-1, H-1, W-1], bool, at least one.
        """
        corners = cell_corners(cells.reshape(-1).nonzero()[:, 0], self.shape)
        origins = self.grid.nodes(self.shape).reshape(-1, 3)[corners[:, 0]]
        transforms = blend_transforms(self.weight_grid(), bone_transforms[None])[0][corners]
        lower, upper = posed_cell_boxes(transforms, origins, self.grid.cell_size(self.shape))
        return lower.amin(0).cpu(), upper.amax(0).cpu()

    def random_canonical(self, count: int, generator: torch.Generator) -> Tensor:
        """Return canonical points [count, 3] spread evenly over the active cells, metres."""
        cells = self.active_cells.nonzero()
        chosen = torch.randint(len(cells), (count,), generator=generator).to(cells.device)
        places = torch.rand(count, 3, generator=generator).to(self.lower)
        return self.lower + (cells[chosen].flip(1) + places) * self.grid.cell_size(self.shape)

    def skin(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        """Move canonical points [N, 3] into one pose [J, 4, 4]; the inverse of the search."""
        return skin(canonical, self.skinning_weights(canonical), bone_transforms)

    def smoothness(self, weights: NodeWeights | None = None) -> Tensor:
        """Return the total variation of the weights over the nodes of active cells (see `total_variation`).

        Args:
            weights: from `node_weights`, if they have been evaluated already.
        """
        values = self.weight_grid(active_only=True) if weights is None else weights.values
        return total_variation(values, self.grid, self._used_nodes)


def _make_field(
    grid: CanonicalGrid,
    shape: tuple[int, int, int],
    num_bones: int,
    skinning: SkinningConfig,
    prior: BonePrior | None,
    parents: Sequence[int] | None,
    mirror: Sequence[int] | None,
) -> WeightField:
    """Return the weight field of the settings."""
    if skinning.name == "preset":
        raise ValueError("field: wanted weights for skinning.name 'preset', got None; give PresetWeights.from_vertices(...)")
    softmax = make_softmax(skinning.softmax, num_bones, parents)
    if skinning.name == "voxel":
        return VoxelWeights(softmax, grid, shape, skinning.sharpness, prior, mirror)
    return NetworkWeights(softmax, grid, skinning.width, skinning.depth, skinning.sharpness, skinning.weight_norm, prior)


def _after_load(deformer: ForwardDeformer, incompatible: object) -> None:
    """Update what follows from the state after load_state_dict: the field's box and the nodes of active cells."""
    deformer._frozen = None
    if not bool(deformer.active_cells.any()):
        raise ValueError("active_cells: wanted at least one cell, got none")
    deformer._update_active_nodes()
    if isinstance(deformer.field, WeightField):
        deformer.field.set_box(deformer.grid)
