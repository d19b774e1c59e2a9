"""The forward-skinning module: a weight field, posed points in, canonical correspondences out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor, nn

from snarfcli.deformer.cells import corners_of
from snarfcli.deformer.complete import posed_cell_boxes
from snarfcli.deformer.correspondences import Correspondences, check_transforms, find_correspondences
from snarfcli.deformer.field_search import find_correspondences_on_field
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate
from snarfcli.deformer.hierarchy import make_softmax
from snarfcli.deformer.search_config import SearchConfig
from snarfcli.deformer.skinning import blend_transforms, interpolate, skin
from snarfcli.deformer.weights import BonePrior, GridWeights, NetworkWeights, VoxelWeights, WeightField, total_variation

__all__ = ["FIELDS", "ForwardDeformer", "SkinningConfig"]

FIELDS = ("distilled", "voxel", "mlp", "preset")
"""Names of the weight fields."""


@dataclass
class SkinningConfig:
    name: str = "distilled"
    """Weight field: distilled (a network evaluated at the grid nodes), voxel (optimised at the nodes), mlp (a network that is
    searched directly, as in SNARF) or preset (given, not trained)."""
    softmax: str = "plain"
    """From logits to weights: plain, or hierarchical down the tree of joints; of no effect on preset weights."""
    resolution: list[int] = field(default_factory=lambda: [64, 64, 16])
    """Grid nodes along x, y, z; a skeleton that is not SMPL's has as many in all, shared out by the sides of its box."""
    margin_m: list[float] = field(default_factory=lambda: [0.12, 0.12, 0.20])
    """What the grid's box adds around the canonical body on either side, along x, y, z, metres."""
    bone_radius_m: float | None = 0.22
    """Cells with a corner this near to a bone are searched at first, metres; null searches every cell, always."""
    surface_radius_m: float = 0.12
    """So are cells this near to the rough points of the body that the grid's box was made from, metres."""
    width: int = 128
    """Width of the network's hidden layers."""
    depth: int = 4
    """Number of hidden layers."""
    sharpness: float = 20.0
    """Factor before the softmax over the bones."""
    weight_norm: bool = True
    """Whether the network's layers are weight-normalised."""
    prior_falloff_m: float | None = None
    """The field corrects weights that fall by a factor e over this distance to a bone, metres; null for no such prior."""
    smoothness: float = 0.0
    """Weight of the loss that keeps voxel weights from changing between neighbouring nodes."""
    weights_file: str | None = None
    """Preset weights: .npz file with vertices [V, 3], canonical pose, metres, and weights [V, J]; kept in the avatar."""


class ForwardDeformer(nn.Module):
    """Find the canonical correspondences of posed points under learned forward skinning.

    Args:
        grid: canonical box of the weight grid.
        num_bones: J, the number of bone transforms.
        skinning: the weight field.
        search: how correspondences are found; weights that are searched directly (skinning.name "mlp") need "broyden".
        active_cells: bool [D-1, H-1, W-1], the cells that a complete search looks into (see `cells_near`); None for all.
        prior: weights that the field only corrects.
        parents: parent of each bone, negative for a root; for skinning.softmax "hierarchical".
        field: a weight field of your own instead of the one that `skinning` describes: a module or function from canonical
            points [N, 3], metres, to weights [N, J], rows sum to 1. It is evaluated at the grid nodes, or searched directly if
            skinning.name is "mlp". A module is trained, moved and saved with the deformer.

    Raises:
        ValueError: a setting does not exist, or does not go with the others.
    """

    def __init__(
        self,
        grid: CanonicalGrid,
        num_bones: int,
        skinning: SkinningConfig | None = None,
        search: SearchConfig | None = None,
        active_cells: Tensor | None = None,
        prior: BonePrior | None = None,
        *,
        parents: Sequence[int] | None = None,
        field: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        skinning = skinning or SkinningConfig()
        if skinning.name not in FIELDS:
            raise ValueError(f"skinning.name must be one of {', '.join(FIELDS)}, got {skinning.name!r}")
        width, height, depth = skinning.resolution
        self.shape = (depth, height, width)
        self.num_bones = num_bones
        self.searches_field = skinning.name == "mlp"
        """Whether roots are those of the field itself and not of its values at the grid nodes."""
        self.search = search or SearchConfig(name="broyden" if self.searches_field else "complete")
        self.field = field if field is not None else _make_field(grid, self.shape, num_bones, skinning, prior, parents)
        if isinstance(self.field, GridWeights) and self.field.shape != self.shape:
            raise ValueError(f"field must have nodes {list(self.shape)} (z, y, x) as the grid, got {list(self.field.shape)}")
        self.register_buffer("lower", grid.lower.clone())
        self.register_buffer("upper", grid.upper.clone())
        self.register_buffer("active_cells", torch.ones([n - 1 for n in self.shape], dtype=torch.bool))
        if active_cells is not None:
            self.set_active_cells(active_cells)
        self._frozen: Tensor | None = None
        self._recent: Tensor | None = None
        self.register_load_state_dict_post_hook(_take_over_box)

    @property
    def search(self) -> SearchConfig:
        """How correspondences are found."""
        return self._search

    @search.setter
    def search(self, search: SearchConfig) -> None:
        if self.searches_field and search.name != "broyden":
            raise ValueError(f"skinning.name 'mlp' needs search.name 'broyden', got {search.name!r}: it has no cells to search")
        self._search = search

    @property
    def grid(self) -> CanonicalGrid:
        """The box of the weight grid."""
        return CanonicalGrid(self.lower, self.upper, checked=True)

    def weight_grid(self, active_only: bool = False) -> Tensor:
        """Return the skinning weights at the grid nodes, [D, H, W, J].

        With `active_only` just the nodes of active cells are evaluated, the only ones that a complete search reads; the others
        are zero.
        """
        if self._frozen is not None:
            return self._frozen
        at_nodes = self.field.at_nodes if isinstance(self.field, GridWeights) else None
        nodes = self.grid.nodes(self.shape).reshape(-1, 3)
        if not active_only:
            weights = self._checked(self.field(nodes) if at_nodes is None else at_nodes(), len(nodes))
            return weights.reshape(*self.shape, -1)
        used = corners_of(self.active_cells).reshape(-1).nonzero()[:, 0]
        weights = self._checked(self.field(nodes[used]) if at_nodes is None else at_nodes(used), len(used))
        return weights.new_zeros(len(nodes), self.num_bones).index_copy(0, used, weights).reshape(*self.shape, -1)

    def _checked(self, weights: Tensor, count: int) -> Tensor:
        """Refuse what a field of the user's own must not return."""
        if tuple(weights.shape) != (count, self.num_bones):
            raise ValueError(f"field must return weights of shape [{count}, {self.num_bones}], got {list(weights.shape)}")
        return weights

    def freeze(self) -> ForwardDeformer:
        """Evaluate the weight grid once and keep it; call this after training. `train()` undoes it."""
        self.eval()
        self._frozen = None
        with torch.no_grad():
            self._frozen = self.weight_grid()
        return self

    def train(self, mode: bool = True) -> ForwardDeformer:
        """Switch between training and evaluation; either way a frozen weight grid is forgotten."""
        self._frozen = None
        return super().train(mode)

    def _apply(self, fn, recurse=True):
        self._frozen = self._recent = None
        return super()._apply(fn, recurse)

    def forward(self, points: Tensor, bone_transforms: Tensor, capacity: int | None = None) -> Correspondences:
        """Find the correspondences of posed points [B, N, 3] under bone transforms [B, J, 4, 4], canonical to posed.

        In full precision, also under autocast. `capacity` is that of `find_correspondences`; a field that is searched directly
        takes none.
        """
        with torch.autocast(points.device.type, enabled=False):
            return self._forward(points, bone_transforms, capacity)

    def _forward(self, points: Tensor, bone_transforms: Tensor, capacity: int | None) -> Correspondences:
        options = asdict(self.search)
        name = options.pop("name")
        if not self.searches_field:
            complete = name == "complete"
            active = self.active_cells if complete else None
            weights = self.weight_grid(active_only=complete)
            self._recent = weights.detach()
            own = isinstance(self.field, WeightField)  # its weights sum to one
            if own:
                check_transforms(bone_transforms)
            return find_correspondences(
                points,
                bone_transforms,
                weights,
                self.grid,
                search=name,
                active_cells=active,
                capacity=capacity,
                check=not own,
                **options,
            )
        if capacity is not None:
            raise ValueError("capacity needs a search on the grid; a field that is searched directly takes none")
        length = self.grid.longest_side
        return find_correspondences_on_field(
            points,
            bone_transforms,
            self.field,
            grid=self.grid,
            init_bones=options["init_bones"],
            tolerance=options["tolerance"] * length,
            max_steps=options["max_steps"],
            divergence=options["divergence"] * length,
            jacobian=options["jacobian"],
            orientation_preserving=options["orientation_preserving"],
        )

    def set_active_cells(self, cells: Tensor) -> None:
        """Choose the cells that a complete search looks into, bool [D-1, H-1, W-1]; they are saved with the state.

        Raises:
            ValueError: the shape or dtype differs, or no cell is left.
        """
        wanted = [n - 1 for n in self.shape]
        if list(cells.shape) != wanted or cells.dtype != torch.bool:
            raise ValueError(f"active_cells must be bool {wanted}, got {cells.dtype} {list(cells.shape)}")
        if not bool(cells.any()):
            raise ValueError("active_cells must hold at least one cell, got none")
        self.active_cells.copy_(cells)

    def is_active(self, canonical: Tensor) -> Tensor:
        """Return which canonical points [N, 3] lie in cells that a complete search looks into, bool [N]."""
        cell, local = locate(canonical, self.grid, self.shape)
        return ((local >= 0) & (local <= 1)).all(1) & self.active_cells.reshape(-1)[cell]

    def posed_box(self, bone_transforms: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of a box around the images of `cells` in one pose, metres.

        It bounds the field that is trilinear between the nodes. One that is searched directly may curve a little beyond.

        Args:
            bone_transforms: [J, 4, 4], canonical to posed.
            cells: bool [D-1, H-1, W-1], at least one.
        """
        corners = cell_corners(cells.reshape(-1).nonzero()[:, 0], self.shape)
        origins = self.grid.nodes(self.shape).reshape(-1, 3)[corners[:, 0]]
        transforms = blend_transforms(self.weight_grid(), bone_transforms[None])[0][corners]
        lower, upper = posed_cell_boxes(transforms, origins, self.grid.cell_size(self.shape))
        return lower.amin(0).cpu(), upper.amax(0).cpu()

    def skinning_weights(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3]: those that the search goes by."""
        if self.searches_field:
            return self._checked(self.field(canonical), len(canonical))
        return interpolate(self.weight_grid(), canonical, self.grid)

    def random_canonical(self, count: int, generator: torch.Generator) -> Tensor:
        """Return canonical points [count, 3] spread evenly over the active cells, metres."""
        cells = self.active_cells.nonzero()
        chosen = torch.randint(len(cells), (count,), generator=generator).to(cells.device)
        places = torch.rand(count, 3, generator=generator).to(self.lower)
        return self.lower + (cells[chosen].flip(1) + places) * self.grid.cell_size(self.shape)

    @torch.no_grad()
    def remember_weights(self) -> None:
        """Evaluate the weights at the nodes of active cells for `recent_weights`, as a search does."""
        if not self.searches_field and self._frozen is None:
            self._recent = self.weight_grid(active_only=True)

    @torch.no_grad()
    def recent_weights(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3] as of the last search, without a gradient.

        In training this spares evaluating the field at the nodes once more; points lie in active cells.
        """
        if self.searches_field or self._recent is None or self._frozen is not None:
            return self.skinning_weights(canonical)
        return interpolate(self._recent, canonical, self.grid)

    def skin(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        """Move canonical points [N, 3] into one pose [J, 4, 4]; the exact inverse of the search."""
        return skin(canonical, self.skinning_weights(canonical), bone_transforms)

    def smoothness(self) -> Tensor:
        """Return the total variation of the weights over the nodes of active cells (see `total_variation`)."""
        return total_variation(self.weight_grid(active_only=True), self.grid, corners_of(self.active_cells))


def _make_field(
    grid: CanonicalGrid,
    shape: tuple[int, int, int],
    num_bones: int,
    skinning: SkinningConfig,
    prior: BonePrior | None,
    parents: Sequence[int] | None,
) -> WeightField:
    """Return the weight field that the settings describe."""
    if skinning.name == "preset":
        raise ValueError("skinning.name 'preset' needs field=PresetWeights.from_vertices(...)")
    softmax = make_softmax(skinning.softmax, num_bones, parents)
    if skinning.name == "voxel":
        return VoxelWeights(softmax, grid, shape, skinning.sharpness, prior)
    return NetworkWeights(softmax, grid, skinning.width, skinning.depth, skinning.sharpness, skinning.weight_norm, prior)


def _take_over_box(deformer: ForwardDeformer, incompatible: object) -> None:
    """Tell the field of the box that was read with a state."""
    deformer._frozen = None
    if isinstance(deformer.field, WeightField):
        deformer.field.set_box(deformer.grid)
