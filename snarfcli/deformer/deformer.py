"""The forward-skinning module: takes posed points, returns their canonical correspondences under a weight field."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from snarfcli.deformer.bone_prior import BonePrior
from snarfcli.deformer.canonical_body import CanonicalBody, canonical_body, weights_around
from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.diffusion import PresetWeights
from snarfcli.deformer.field_search import find_correspondences_on_field
from snarfcli.deformer.forward_skinning import ForwardSkinning
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.grid_search import BlendedPoses, check_transforms, check_values, find_correspondences
from snarfcli.deformer.hierarchy import make_softmax
from snarfcli.deformer.posed import PosedDeformer, PosedField, PosedGrid
from snarfcli.deformer.search_config import SearchConfig, as_search_config, check_search_config
from snarfcli.deformer.skinning_config import FIELDS, SkinningConfig
from snarfcli.deformer.weights import GridWeights, NetworkWeights, NodeWeights, VoxelWeights, WeightField
from snarfcli.precision import without_autocast

__all__ = ["ForwardDeformer"]


class ForwardDeformer(ForwardSkinning):
    """Find the canonical correspondences of posed points under learned forward skinning.

    Args:
        grid: canonical box of the weight grid.
        num_bones: J, the number of bone transforms.
        skinning: the weight field; None for the defaults, or for the nodes of a `field` that is defined at grid nodes.
        search: how correspondences are found; weights that are searched directly (skinning.name "mlp") need "broyden".
        active_cells: [D-1, H-1, W-1], bool, the cells that a complete search looks into (see `cells_near`); None for all.
        prior: weights that the field only corrects.
        parents: parent of each bone, negative for a root; for skinning.softmax "hierarchical".
        field: a custom weight field instead of the one that `skinning` describes: a module or function from canonical
            points [N, 3], metres, to weights [N, J], rows sum to 1. If it has a parameter named `pose_index`, it also gets the
            pose of each point, [N], and the weights may differ from pose to pose. It is evaluated at the grid nodes, or
            searched directly if skinning.name is "mlp". A module is trained, moved and saved with the deformer.
        mirror: the bone to which each is mapped by the symmetry of voxel weights, see `VoxelWeights`; None for none.

    Raises:
        ValueError: a setting does not exist, or does not fit the others.
    """

    body: CanonicalBody | None = None
    """The body that the deformer was made for by `from_body`; moves with the deformer, and is not part of the state."""

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
        field: Callable[..., Tensor] | None = None,
        mirror: Sequence[int] | None = None,
    ) -> None:
        if skinning is None:
            skinning = _settings_of(field)
        if skinning.name not in FIELDS:
            raise ValueError(f"skinning.name: wanted {', '.join(FIELDS[:-1])} or {FIELDS[-1]}, got {skinning.name!r}")
        if len(skinning.resolution) != 3 or min(skinning.resolution) < 2:
            raise ValueError(f"skinning.resolution: wanted three numbers of at least 2, got {list(skinning.resolution)}")
        if field is not None and not callable(field):
            raise TypeError(f"field: wanted a function of canonical points, got a {type(field).__name__}")
        if num_bones < 1:
            raise ValueError(f"num_bones: wanted at least 1, got {num_bones}")
        width, height, depth = skinning.resolution
        shape = (depth, height, width)
        if field is None:
            field = _make_field(grid, shape, num_bones, skinning, prior, parents, mirror)
        searches_field = skinning.name == "mlp"
        super().__init__(grid, shape, num_bones, field, searches_field, active_cells)
        self.search = as_search_config(search or ("broyden" if searches_field else None))

    @classmethod
    @without_autocast
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
            margin_m: margin of the box along x, y, z, metres; None: `BodySkinningConfig`, in proportion to the body.
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
    def search(self, search: SearchConfig | str) -> None:
        search = as_search_config(search)
        check_search_config(search, self.num_bones)
        if self.searches_field and search.name != "broyden":
            raise ValueError(
                f"search.name: wanted broyden for skinning.name 'mlp', got {search.name!r}: the field has no cells"
            )
        self._search = search

    def extra_repr(self) -> str:
        """Describe the deformer in the text of the module."""
        nodes = "x".join(map(str, self.shape[::-1]))
        return f"bones={self.num_bones}, nodes={nodes}, search={self.search.name}"

    def _apply(self, fn, recurse=True):
        if self.body is not None:
            self.body = self.body.mapped(fn)
        return super()._apply(fn, recurse)

    def node_weights(self, active_only: bool | None = None, poses: int | None = None) -> NodeWeights | None:
        """Evaluate the skinning weights at the nodes that a search reads; None for a field that is searched directly.

        A search and `skinning_weights` take the result, so that the field is evaluated once for both.

        Args:
            active_only: whether only nodes of active cells are evaluated; None: as the search needs it.
            poses: B, for a field with a parameter `pose_index`; otherwise of no effect.
        """
        return super().node_weights(self.search.name == "complete" if active_only is None else active_only, poses)

    # ---------------------------------------------------------------- search
    def forward(
        self,
        points: Tensor,
        bone_transforms: Tensor,
        capacity: int | None = None,
        weights: NodeWeights | None = None,
        starts: Tensor | None = None,
    ) -> Correspondences:
        """Find the correspondences of posed points, in full precision, also under autocast.

        For many calls in the same poses see `pose`.

        Args:
            points: [B, N, 3], posed space, metres.
            bone_transforms: [B, J, 4, 4], canonical to posed.
            capacity: as in `find_correspondences`; not for a field that is searched directly.
            weights: from `node_weights`, if they have been evaluated already.
            starts: [B, N, I, 3], canonical points from which a broyden search starts, metres; None for the start bones.
        """
        self._check_call(points, bone_transforms)
        with torch.autocast(self.lower.device.type, enabled=False):
            if self.searches_field:
                if capacity is not None:
                    raise ValueError(
                        "capacity: wanted None for a field that is searched directly; it needs a search on the grid"
                    )
                return find_correspondences_on_field(
                    points, bone_transforms, self.field, self.grid, starts=starts, search=self.search
                )
            if weights is None:
                weights = self._searched_weights(len(bone_transforms))
            if self._sums_to_one:
                check_transforms(bone_transforms)
            return find_correspondences(
                points,
                bone_transforms,
                weights.values,
                self.grid,
                search=self.search,
                starts=starts,
                active_cells=self._searched_cells,
                capacity=capacity,
                check=not self._sums_to_one,
            )

    def _check_call(self, points: Tensor, bone_transforms: Tensor) -> None:
        """Raise TypeError for arguments that are no tensors, as in calls of other deformers, or of another dtype."""
        for name, value in (("points", points), ("bone_transforms", bone_transforms)):
            if not isinstance(value, Tensor):
                wanted = "a tensor in deformer(points, bone_transforms), without further conditions"
                raise TypeError(f"{name}: wanted {wanted}, got a {type(value).__name__}")
            if value.is_floating_point() and value.dtype != self.lower.dtype:
                raise TypeError(f"{name}: wanted the dtype of the deformer, {self.lower.dtype}, got {value.dtype}")

    def pose(self, bone_transforms: Tensor, weights: NodeWeights | None = None) -> PosedDeformer:
        """Prepare poses for many calls: the transforms are blended, and the cells sorted, once.

        `posed = deformer.pose(transforms)`, then `posed(points)` returns what `deformer(points, transforms)` does. On a CPU a
        million points in 200 calls take one to three times as long as in one call; without a prepared pose, 10 to 140 times.

        Args:
            bone_transforms: [B, J, 4, 4], canonical to posed, metres, of the dtype and on the device of the deformer.
            weights: from `node_weights`, if they have been evaluated already; `skin` and `transforms_at` of the poses then take
                points in cells whose nodes were evaluated.

        Raises:
            ValueError, TypeError: as `find_correspondences`.
        """
        if torch.compiler.is_compiling():  # not as a decorator, which would import the compiler: two seconds
            return torch.compiler.disable(self._pose)(bone_transforms, weights)  # pyright: ignore[reportCallIssue]
        return self._pose(bone_transforms, weights)

    def _pose(self, bone_transforms: Tensor, given: NodeWeights | None) -> PosedDeformer:
        """As `pose`. Not to be compiled: pointers of the native library; what the poses do can be compiled."""
        self._check_poses(bone_transforms, given)
        check_search_config(self.search, self.num_bones)
        is_recorded, full_precision = torch.is_grad_enabled(), torch.autocast(bone_transforms.device.type, enabled=False)
        # What is made in inference mode may be used outside of it, where autograd cannot save inference tensors.
        with torch.inference_mode(False), torch.set_grad_enabled(is_recorded), full_precision:
            check_transforms(bone_transforms)
            if self.searches_field:
                return PosedField(
                    bone_transforms, self.field, self.grid, self.search, lambda: self._box_of_nodes(bone_transforms)
                )
            weights = self._searched_weights(len(bone_transforms)) if given is None else given
            cells = None if self._searched_cells is None else self._searched_cells.clone()
            if not self._sums_to_one:
                check_values(self.grid, bone_transforms, weights.values, cells)
            poses = BlendedPoses.of(bone_transforms, weights.values, self.grid, self.search, cells)
            if cells is None or self.searches_all_cells:
                return PosedGrid(bone_transforms, poses, lambda: poses)

            def everywhere() -> BlendedPoses:
                values = self.weight_grid(poses=len(bone_transforms)) if given is None else given.values
                return BlendedPoses.of(bone_transforms, values, self.grid, self.search, None)

            return PosedGrid(bone_transforms, poses, everywhere)

    def _searched_weights(self, poses: int) -> NodeWeights:
        weights = self.node_weights(poses=poses)
        assert weights is not None
        return weights

    @property
    def _searched_cells(self) -> Tensor | None:
        return self.active_cells if self.search.name == "complete" else None

    @property
    def _sums_to_one(self) -> bool:
        """Whether the weights are known to sum to 1, so that this need not be checked."""
        return isinstance(self.field, WeightField)


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


def _settings_of(field: Callable[..., Tensor] | None) -> SkinningConfig:
    """Return the settings for a field: those of its own nodes if it has some, otherwise the defaults."""
    if not isinstance(field, GridWeights):
        return SkinningConfig()
    name = "preset" if isinstance(field, PresetWeights) else "voxel"
    return SkinningConfig(name, resolution=list(field.shape[::-1]))
