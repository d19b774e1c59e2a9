"""A trained model with its skeleton: saving, loading and queries."""

from __future__ import annotations

import copy
from collections.abc import Callable, Hashable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor
from typing_extensions import Self

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.deformer import CanonicalGrid, PresetWeights
from snarfcli.deformer.search_config import check_search_config
from snarfcli.descriptions import check_plain, read_described
from snarfcli.errors import UserError, is_out_of_memory
from snarfcli.files import write_tensors
from snarfcli.models.back_d import BackD
from snarfcli.models.back_lbs import BackLBS
from snarfcli.models.checkpoint import load_checkpoint
from snarfcli.models.described_sizes import check_described_sizes
from snarfcli.models.fast_snarf import FastSnarf
from snarfcli.models.file_tensors import FARTHEST_M, load_state, read_state, read_tensor
from snarfcli.models.in_parts import points_in_parts, queries_in_parts
from snarfcli.models.nasa import Nasa
from snarfcli.models.pose_onet import PoseONet
from snarfcli.models.pretrained import TENSORS_FILE, is_pretrained, read_pretrained
from snarfcli.models.settings import AvatarConfig
from snarfcli.models.smpl_nn import SmplNN
from snarfcli.models.system import NO_CORRESPONDENCE, FieldSamples, Found, System
from snarfcli.precision import PRECISIONS
from snarfcli.texts import one_line

__all__ = ["SYSTEMS", "TrainedField"]

FORMAT = "snarf-avatar"
FORMAT_VERSION = 1
SYSTEMS: dict[str, type[System]] = {
    "fast_snarf": FastSnarf,
    "snarf": FastSnarf,
    "pose_onet": PoseONet,
    "back_lbs": BackLBS,
    "back_d": BackD,
    "nasa": Nasa,
    "piecewise": Nasa,
    "smpl_nn": SmplNN,
}
"""The systems by name, see `ModelConfig.name`."""

_WRONG_CONTENT = (LookupError, TypeError, ValueError, RuntimeError, AttributeError, ArithmeticError)

T = TypeVar("T")


class TrainedField:
    """The posed occupancy field of one subject, which can be saved, loaded and queried.

    Args:
        config: architecture.
        skeleton: joint tree, rest joints and canonical pose.
        grid: canonical box that holds the body.
        surface: [K, 3], rough points of the body, canonical frame, metres, for a new avatar; a saved one has its cells.
        facts: plain facts about the training (data, subject, steps, ...), saved with the avatar.
        field: weight field of a new avatar, instead of the one that `config.skinning` describes; for preset weights.
        template: the subject's mesh in the canonical pose, for systems that use ground-truth skinning weights.

    Raises:
        ValueError: the configuration is not of a system, or does not fit the skeleton.
    """

    file: Path | None = None
    """The file it was loaded from."""
    _precision = "highest"  # of the shape network, see `with_precision`

    def __init__(
        self,
        config: AvatarConfig,
        skeleton: Skeleton,
        grid: CanonicalGrid,
        surface: Tensor | None = None,
        facts: dict[str, Any] | None = None,
        field: Callable[[Tensor], Tensor] | None = None,
        template: MeshTemplate | None = None,
    ) -> None:
        if config.model.name not in SYSTEMS:
            raise ValueError(f"model.name: wanted one of {', '.join(SYSTEMS)}, got {config.model.name!r}")
        self.config = config
        self.skeleton = skeleton
        self.facts = dict(facts or {})
        surface = skeleton.canonical_joints if surface is None else surface
        system = SYSTEMS[config.model.name]
        self.template = template if system.keeps_template else None
        options = {} if field is None else {"field": field}
        build = cast("Callable[..., System]", system)  # every system takes these; the base class takes fewer
        self.model = build(config, skeleton, grid, surface, template, **options)
        self._derived: dict[Hashable, Any] = {}

    # ---------------------------------------------------------------- files
    def save(self, path: str | Path) -> None:
        """Write the avatar to one file, which is whole or absent; `torch.load(weights_only=True)` reads it."""
        write_tensors(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return a complete description of the avatar: plain dicts, lists, numbers and tensors."""
        return {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "config": asdict(self.config),
            "skeleton": self.skeleton.to_dict(),
            "grid": {"lower": self.model.grid.lower.cpu(), "upper": self.model.grid.upper.cpu()},
            "template": None if self.template is None else _describe_template(self.template),
            "state": {name: value.detach().cpu().clone() for name, value in self.model.state_dict().items()},
            "facts": self.facts,
        }

    @classmethod
    def load(cls, path: str | Path, device: str | torch.device = "cpu") -> Self:
        """Read an avatar from its file, or from a run folder or one of `save_pretrained`, ready to use on `device`.

        Raises:
            UserError: the file is missing, damaged, not an avatar, or of another format version.
        """
        path = Path(path)
        if path.is_dir():
            path = path / (TENSORS_FILE if is_pretrained(path) and not (path / "avatar.pt").exists() else "avatar.pt")
        if path.name == TENSORS_FILE:
            content = read_pretrained(path.parent, FORMAT, FORMAT_VERSION)
        else:
            content = load_checkpoint(path, FORMAT, FORMAT_VERSION, "avatar")
        avatar = cls.from_dict(content, path).to(device)
        avatar.file = path
        return avatar

    @classmethod
    def from_dict(cls, content: dict[str, Any], path: str | Path = "avatar") -> Self:
        """Return the avatar that `to_dict` described; `path` is its name in messages.

        Raises:
            UserError: the content does not describe an avatar.
        """
        try:
            avatar = cls._built(content)
        except _WRONG_CONTENT as error:
            if is_out_of_memory(error):
                raise MemoryError(f"not enough memory to load {path}; close other programs") from None
            reason = f"no {error}" if isinstance(error, KeyError) else one_line(error, 300)
            raise UserError(
                f"{path} does not describe an avatar of this version ({reason}); train it again, or get it again"
            ) from None
        avatar.model.eval()
        return avatar

    @classmethod
    def _built(cls, content: dict[str, Any]) -> Self:
        """Return the avatar of a description, which may be from any file: it is checked before anything is built.

        Raises:
            LookupError, TypeError, ValueError, RuntimeError, AttributeError, ArithmeticError: it does not describe an avatar.
        """
        config = read_described(AvatarConfig, content["config"], "config")
        if config.model.name not in SYSTEMS:
            raise ValueError(f"model.name: wanted one of {', '.join(SYSTEMS)}, got {config.model.name!r:.60}")
        check_plain(content["facts"], "facts", finite=False)
        skeleton = Skeleton.from_dict(content["skeleton"])
        lower, upper = (
            read_tensor(content["grid"][name], f"grid.{name}", (3,), below=FARTHEST_M) for name in ("lower", "upper")
        )
        grid = CanonicalGrid(lower, upper)
        template = _read_template(content.get("template"), config.model.name, skeleton.num_joints)
        state = read_state(content["state"])
        check_described_sizes(config, skeleton.num_joints, grid, state)
        field = None
        if config.skinning.name == "preset" and config.model.name == "fast_snarf":
            width, height, depth = config.skinning.resolution
            field = PresetWeights.placeholder(grid, (depth, height, width), skeleton.num_joints)
        avatar = cls(config, skeleton, grid, facts=dict(content["facts"]), field=field, template=template)
        if avatar.model.search is not None:
            check_search_config(avatar.model.search, skeleton.num_joints)
        load_state(avatar.model, state)
        return avatar

    def to(self, device: str | torch.device) -> Self:
        """Move the avatar to a device and compute there what does not depend on the pose."""
        self.model.to(device)
        self.model.freeze()
        self._derived.clear()
        return self

    def with_model(self, model: System) -> Self:
        """Return a copy with another model, with separate facts and without derived objects."""
        other = copy.copy(self)
        other.model, other.facts, other._derived = model, copy.deepcopy(self.facts), {}
        return other

    def with_precision(self, precision: str) -> Self:
        """Return a copy whose shape network computes in another precision, and with it queries, meshes and exports.

        The copy shares the model. On a CPU the native library always computes in float32.

        Args:
            precision: of products on a GPU: "highest" (float32), "high" or "medium" (TF32) or "bfloat16".

        Raises:
            ValueError: it is none of these.
        """
        other = self.with_model(self.model)
        other._precision = _checked(precision)
        return other

    @property
    def precision(self) -> str:
        """Precision of the shape network, see `with_precision`."""
        return self._precision

    @property
    def device(self) -> torch.device:
        """Device on which the avatar computes."""
        return self.model.grid.lower.device

    @property
    def has_skinning_weights(self) -> bool:
        """Whether canonical points have skinning weights, so that a canonical mesh can be skinned."""
        return self.model.has_skinning_weights

    def derived(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Return `compute()`, cached by key until the field moves to another device.

        For expensive results that depend only on the field, such as its canonical surface.
        """
        if key not in self._derived:
            self._derived[key] = compute()
        return self._derived[key]

    # ---------------------------------------------------------------- the field
    def bone_transforms(self, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        """Return the bone transforms [B, J, 4, 4], canonical to posed, metres, of poses.

        Args:
            pose: [B, J, 3], axis-angle, radians, global orientation included.
            translation: [B, 3], metres.

        Raises:
            ValueError: the pose has a wrong shape, or is not finite.
        """
        joints = self.skeleton.num_joints
        if pose.ndim != 3 or tuple(pose.shape[1:]) != (joints, 3):
            raise ValueError(f"pose: wanted shape [B, {joints}, 3], got {list(pose.shape)}")
        if not bool(pose.isfinite().all()):
            raise ValueError("pose: wanted finite values, got NaN or infinite ones")
        return self.skeleton.posed_from_canonical(pose, translation).to(self.device)

    def query(self, points: Tensor, bone_transforms: Tensor, pose: Tensor, precision: str | None = None) -> FieldSamples:
        """Evaluate the posed field at points [B, N, 3] under bone transforms [B, J, 4, 4] and pose [B, J, 3].

        Points are evaluated in parts: besides the result, 13 bytes per point, it needs less than 1 GiB for any number of them.

        Args:
            points, bone_transforms, pose: posed points and the transforms, metres; axis-angle, radians.
            precision: of the shape network, see `with_precision`; None for the avatar's. Correspondences are always found in
                float32.

        Raises:
            ValueError: the precision is unknown.
        """

        def evaluate(points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
            values = self.shape_at(self.find(points, bone_transforms, pose), pose, precision)
            return values.logits, values.found, values.counts

        return FieldSamples(*queries_in_parts(evaluate, points, bone_transforms, pose))

    @torch.no_grad()
    def find(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> Found:
        """Go back to the canonical frame, the first half of `query`; all points at once, about 0.8 kB for each."""
        return self.model.find(points.to(self.device), bone_transforms.to(self.device), pose.to(self.device))

    @torch.no_grad()
    def shape_at(self, found: Found, pose: Tensor, precision: str | None = None) -> FieldSamples:
        """Evaluate the shape network where `find` has led, the second half of `query`."""
        chosen = self._precision if precision is None else _checked(precision)
        return self.model.shape_at(found, pose.to(self.device), chosen)

    def occupancy(self, points: Tensor, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        """Return occupancy probabilities [B, N] at posed points [B, N, 3], metres.

        Besides the result it needs less than 1 GiB for any number of points, see `query`.

        Args:
            points: [B, N, 3], posed frame, metres.
            pose: [B, J, 3], axis-angle, radians, global orientation included.
            translation: [B, 3], metres.
        """

        def evaluate(points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
            return (self.query(points, bone_transforms, pose).logits,)

        return queries_in_parts(evaluate, points, self.bone_transforms(pose, translation), pose)[0].sigmoid_()

    @torch.no_grad()
    def canonical_logits(self, canonical: Tensor, pose: Tensor) -> Tensor:
        """Return occupancy logits [N] at canonical points [N, 3] for the shape of one pose [J, 3].

        Outside the searched cells, where the network is not trained, they are `NO_CORRESPONDENCE`.

        Raises:
            ValueError: the system has no canonical shape.
        """
        if not self.model.has_canonical_shape:
            raise ValueError(f"model {self.config.model.name} has no canonical shape")
        condition = self.model.condition(pose[None].to(self.device))

        def evaluate(points: Tensor) -> Tensor:
            points = points.to(self.device)
            searched = self.model.is_searched(points).nonzero()[:, 0]
            values = self.model.canonical_logits(points[searched], condition, torch.zeros_like(searched), self._precision)
            return points.new_full((len(points),), NO_CORRESPONDENCE).index_copy(0, searched, values)

        return points_in_parts(evaluate, canonical)

    @torch.no_grad()
    def skinning_weights(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3]; ValueError if the system has none."""
        return points_in_parts(lambda points: self.model.skinning_weights(points.to(self.device)), canonical)

    @torch.no_grad()
    def skin(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        """Move canonical points [N, 3] into the pose of bone transforms [J, 4, 4]; ValueError if the system has no weights."""
        transforms = bone_transforms.to(self.device)
        return points_in_parts(lambda points: self.model.skin(points.to(self.device), transforms), canonical)

    def canonical_box(self) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of the canonical box that holds the body, metres."""
        return self.model.grid.lower.cpu(), self.model.grid.upper.cpu()

    @torch.no_grad()
    def posed_box(self, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of a box that holds the whole body in one pose [J, 4, 4], metres."""
        return self.model.posed_box(bone_transforms.to(self.device))


def _checked(precision: str) -> str:
    if precision not in PRECISIONS:
        raise ValueError(f"precision: wanted one of {', '.join(PRECISIONS)}, got {precision!r}")
    return precision


def _describe_template(template: MeshTemplate) -> dict[str, Tensor]:
    """Return the description of a template in a file: without faces, which no system uses."""
    return {name: torch.tensor(getattr(template, name), dtype=torch.float32) for name in ("vertices", "weights")}


def _read_template(content: Any, model: str, num_joints: int) -> MeshTemplate | None:
    """Return the template mesh in a file, or None if the system has no template.

    Raises:
        ValueError: the system needs a template, and the file has no usable one.
    """
    if model not in SYSTEMS or not SYSTEMS[model].keeps_template:
        return None
    if not isinstance(content, dict):
        raise ValueError(f"model {model} needs a template, got {type(content).__name__}")
    for name, columns in (("vertices", 3), ("weights", num_joints)):
        read_tensor(content[name], f"template.{name}", (None, columns), below=FARTHEST_M)
    vertices, weights = (content[name].numpy() for name in ("vertices", "weights"))
    template = MeshTemplate(vertices, np.zeros((0, 3), np.int32), weights)
    if not len(template.vertices) or len(template.vertices) != len(template.weights):
        raise ValueError(f"template: {len(template.vertices)} vertices, but weights for {len(template.weights)}")
    return template
