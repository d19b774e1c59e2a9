"""A trained model with its skeleton, saved as one safe file, and the queries that it answers."""

from __future__ import annotations

import copy
from collections.abc import Callable, Hashable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor
from typing_extensions import Self

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.deformer import CanonicalGrid, PresetWeights
from snarfcli.errors import UserError
from snarfcli.files import write_tensors
from snarfcli.models.back_d import BackD
from snarfcli.models.back_lbs import BackLBS
from snarfcli.models.checkpoint import load_checkpoint
from snarfcli.models.fast_snarf import FastSnarf, Snarf
from snarfcli.models.nasa import Nasa, Piecewise
from snarfcli.models.pose_onet import PoseONet
from snarfcli.models.settings import AvatarConfig
from snarfcli.models.smpl_nn import SmplNN
from snarfcli.models.system import NO_CORRESPONDENCE, FieldSamples, Found, System

__all__ = ["SYSTEMS", "TrainedField"]

FORMAT = "snarf-avatar"
FORMAT_VERSION = 1
SYSTEMS: dict[str, type[System]] = {
    "fast_snarf": FastSnarf,
    "snarf": Snarf,
    "pose_onet": PoseONet,
    "back_lbs": BackLBS,
    "back_d": BackD,
    "nasa": Nasa,
    "piecewise": Piecewise,
    "smpl_nn": SmplNN,
}
"""The systems by the names that `model` gives them."""

T = TypeVar("T")


class TrainedField:
    """The posed occupancy field of one subject: it is saved, loaded and queried.

    Args:
        config: architecture.
        skeleton: joint tree, rest joints and canonical pose.
        grid: canonical box that holds the body.
        surface: rough points of the body, [K, 3], canonical, metres, for a new avatar; a saved one knows where to search.
        facts: plain facts about its making (data, subject, steps, ...), saved with it.
        field: weight field of a new avatar instead of the one that `config.skinning` describes; preset weights need it.
        template: the subject's mesh with its skinning weights, for the systems that are told them.
    """

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
            raise ValueError(f"model.name must be one of {', '.join(SYSTEMS)}, got {config.model.name!r}")
        self.config = config
        self.skeleton = skeleton
        self.facts = dict(facts or {})
        surface = skeleton.canonical_joints if surface is None else surface
        system = SYSTEMS[config.model.name]
        self.template = template if system.keeps_template else None
        options = {} if field is None else {"field": field}
        self.model = system(config, skeleton, grid, surface, template, **options)
        self._derived: dict[Hashable, Any] = {}

    # ---------------------------------------------------------------- files
    def save(self, path: str | Path) -> None:
        """Write the avatar to one file, whole or not at all; `torch.load(weights_only=True)` reads it."""
        write_tensors(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return plain dicts, lists, numbers and tensors that describe the avatar completely."""
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
        """Read an avatar from its file, or from the `avatar.pt` in a run folder, and make it ready to use on `device`.

        Raises:
            UserError: the file is missing, damaged, no avatar, or of another format version.
        """
        path = Path(path) / "avatar.pt" if Path(path).is_dir() else Path(path)
        return cls.from_dict(load_checkpoint(path, FORMAT, FORMAT_VERSION, "avatar"), path).to(device)

    @classmethod
    def from_dict(cls, content: dict[str, Any], path: str | Path = "avatar") -> Self:
        """Build the avatar that `to_dict` described; `path` only names it in messages."""
        try:
            config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(AvatarConfig), content["config"]))
            grid = CanonicalGrid(content["grid"]["lower"], content["grid"]["upper"])
            skeleton = Skeleton.from_dict(content["skeleton"])
            template = _read_template(content.get("template"), config.model.name, skeleton.num_joints)
            field = None
            if config.skinning.name == "preset" and config.model.name == "fast_snarf":
                field = PresetWeights.placeholder(grid, tuple(config.skinning.resolution[::-1]), skeleton.num_joints)
            avatar = cls(config, skeleton, grid, facts=content["facts"], field=field, template=template)
            avatar.model.load_state_dict(content["state"])
        except (
            LookupError, TypeError, ValueError, RuntimeError, AttributeError, ArithmeticError, MemoryError,
            OmegaConfBaseException,
        ) as error:  # fmt: skip
            reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise UserError(f"{path} does not describe an avatar of this version ({reason}); train it again") from None
        avatar.model.eval()
        return avatar

    def to(self, device: str | torch.device) -> Self:
        """Move the avatar to a device and freeze there what does not depend on the pose."""
        self.model.to(device)
        self.model.freeze()
        self._derived.clear()
        return self

    def with_model(self, model: System) -> Self:
        """Return a copy that answers from another model; its facts and what is derived from the model are separate."""
        other = copy.copy(self)
        other.model, other.facts, other._derived = model, copy.deepcopy(self.facts), {}
        return other

    @property
    def device(self) -> torch.device:
        """Where the avatar computes."""
        return self.model.grid.lower.device

    @property
    def has_skinning_weights(self) -> bool:
        """Whether canonical points have skinning weights, so that a canonical mesh can be moved."""
        return self.model.has_skinning_weights

    def derived(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Return `compute()`, computed once per key and kept until the field moves to another device.

        For what is expensive and follows from the field alone, such as its canonical surface.
        """
        if key not in self._derived:
            self._derived[key] = compute()
        return self._derived[key]

    # ---------------------------------------------------------------- the field
    def bone_transforms(self, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        """Return the bone transforms [B, J, 4, 4], canonical to posed, of pose [B, J, 3] and translation [B, 3]."""
        joints = self.skeleton.num_joints
        if pose.ndim != 3 or tuple(pose.shape[1:]) != (joints, 3):
            raise ValueError(f"pose must have shape [B, {joints}, 3], got {list(pose.shape)}")
        if not bool(pose.isfinite().all()):
            raise ValueError("pose must be finite, got NaN or infinite values")
        return self.skeleton.posed_from_canonical(pose, translation).to(self.device)

    def query(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> FieldSamples:
        """Evaluate the posed field at points [B, N, 3] under bone transforms [B, J, 4, 4] and pose [B, J, 3]."""
        return self.shape_at(self.find(points, bone_transforms, pose), pose)

    @torch.no_grad()
    def find(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> Found:
        """Go back to the canonical frame, the first half of `query`."""
        return self.model.find(points.to(self.device), bone_transforms.to(self.device), pose.to(self.device))

    @torch.no_grad()
    def shape_at(self, found: Found, pose: Tensor) -> FieldSamples:
        """Evaluate the shape network where `find` has led, the second half of `query`."""
        return self.model.shape_at(found, pose.to(self.device))

    def occupancy(self, points: Tensor, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        """Return occupancy probabilities [B, N] at posed points [B, N, 3], metres.

        Args:
            points: [B, N, 3], posed space, metres.
            pose: [B, J, 3] axis-angle, radians, global orientation included.
            translation: [B, 3], metres.
        """
        return self.query(points, self.bone_transforms(pose, translation), pose).logits.sigmoid()

    @torch.no_grad()
    def canonical_logits(self, canonical: Tensor, pose: Tensor) -> Tensor:
        """Return occupancy logits [N] at canonical points [N, 3] for the shape of one pose [J, 3].

        Where the search never looks the network was never trained; there it is `NO_CORRESPONDENCE`.

        Raises:
            ValueError: the system has no canonical shape.
        """
        if not self.model.has_canonical_shape:
            raise ValueError(f"model {self.config.model.name} has no canonical shape")
        canonical = canonical.to(self.device)
        searched = self.model.is_searched(canonical).nonzero()[:, 0]
        condition = self.model.condition(pose[None].to(self.device))
        values = self.model.canonical_logits(canonical[searched], condition, torch.zeros_like(searched))
        return canonical.new_full((len(canonical),), NO_CORRESPONDENCE).index_copy(0, searched, values)

    @torch.no_grad()
    def skinning_weights(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3]; ValueError where the system has none."""
        return self.model.skinning_weights(canonical.to(self.device))

    @torch.no_grad()
    def skin(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        """Move canonical points [N, 3] into one pose, given by bone transforms [J, 4, 4]; ValueError without weights."""
        return self.model.skin(canonical.to(self.device), bone_transforms.to(self.device))

    def canonical_box(self) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of the canonical box that holds the body, metres."""
        return self.model.grid.lower.cpu(), self.model.grid.upper.cpu()

    @torch.no_grad()
    def posed_box(self, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of a box that holds the whole body in one pose [J, 4, 4], metres."""
        return self.model.posed_box(bone_transforms.to(self.device))


def _describe_template(template: MeshTemplate) -> dict[str, Tensor]:
    """Return what a file holds of a mesh: no faces, which no system uses."""
    return {name: torch.tensor(getattr(template, name), dtype=torch.float32) for name in ("vertices", "weights")}


def _read_template(content: Any, model: str, num_joints: int) -> MeshTemplate | None:
    """Return the mesh that a file holds for a system, None where the system keeps none.

    Raises:
        ValueError: the system needs one, and the file holds none that can be used.
    """
    if model not in SYSTEMS or not SYSTEMS[model].keeps_template:
        return None
    if not isinstance(content, dict):
        raise ValueError(f"model {model} needs a template, got {type(content).__name__}")
    for name, columns in (("vertices", 3), ("weights", num_joints)):
        part = content[name]
        if not isinstance(part, Tensor) or part.ndim != 2 or part.shape[1] != columns or not len(part):
            came = list(part.shape) if isinstance(part, Tensor) else type(part).__name__
            raise ValueError(f"template.{name}: wanted shape [V, {columns}], got {came}")
        if part.dtype != torch.float32 or not bool(part.isfinite().all()):
            raise ValueError(f"template.{name}: wanted finite numbers of dtype torch.float32")
    vertices, weights = (content[name].numpy() for name in ("vertices", "weights"))
    template = MeshTemplate(vertices, np.zeros((0, 3), np.int32), weights)
    if len(template.vertices) != len(template.weights):
        raise ValueError(f"template: {len(template.vertices)} vertices, but weights for {len(template.weights)}")
    return template
