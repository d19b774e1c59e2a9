"""Settings of `snarf train`, and their checks."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

from snarfcli.checks import check_choice, check_number
from snarfcli.commands.deformer_checks import check_search, check_skinning
from snarfcli.datasets.settings import DataConfig
from snarfcli.deformer import BodySkinningConfig, SearchConfig
from snarfcli.errors import UserError
from snarfcli.models.settings import ModelConfig
from snarfcli.models.trained_field import SYSTEMS
from snarfcli.precision import PRECISIONS
from snarfcli.shape import CONDITIONS, ConditionConfig, ShapeConfig
from snarfcli.training.device_steps import GRAPHS
from snarfcli.training.losses import JOINT_TARGETS
from snarfcli.training.settings import TrainingConfig

__all__ = ["TrainConfig", "check_settings"]

_AT_LEAST_ONE = (
    "steps", "poses_per_step", "bone_points", "validate_every", "checkpoint_every", "agreement_every", "agreement_points",
)  # fmt: skip
_NOT_NEGATIVE = (
    "uniform_points", "surface_points", "far_points", "warmup_steps", "bootstrap_steps", "bone_occupancy_weight",
    "joint_weight", "validation_frames", "validation_ood_frames", "refresh_cells_every", "extend_weights_every", "workers",
    "agreement_weight",
)  # fmt: skip
_LEAST_OF_MODEL = {"part_width": 1, "part_depth": 1, "part_code": 0, "part_weight": 0, "part_points": 1, "components": 1}


@dataclass
class TrainConfig:
    """Settings of `snarf train`."""

    subject: str = MISSING
    """Subject of the avatar, such as 50002."""
    data: DataConfig = MISSING
    """Data set of the samples."""
    model: ModelConfig = MISSING
    """System of the papers."""
    skinning: BodySkinningConfig = MISSING
    """Field of skinning weights."""
    search: SearchConfig = MISSING
    """Correspondence search."""
    shape: ShapeConfig = MISSING
    """Canonical occupancy network."""
    condition: ConditionConfig = MISSING
    """Pose condition of the canonical points."""
    training: TrainingConfig = MISSING
    """Steps, batches and losses."""
    data_root: str = MISSING
    """Folder with the processed samples."""
    output_root: str = MISSING
    """Folder for results; the run folder is <output_root>/<data>/<subject>/<run>."""
    run: str = MISSING
    """Name of the run."""
    resume: bool = MISSING
    """Continue an interrupted run in the same folder; a finished run is not changed."""
    overwrite: bool = MISSING
    """Replace an existing run in the same folder."""
    wait: bool = False
    """Wait while another command writes to the run folder, instead of stopping with an error."""
    device: str = MISSING
    """auto, cpu, cuda or cuda:N."""
    threads: int | None = MISSING
    """Threads for tensor work; null keeps PyTorch's choice."""
    seed: int = MISSING
    """Seed of all random numbers."""
    experiment: str | None = None
    """Preset of settings, which other settings override; null for none."""


def check_settings(config: TrainConfig) -> None:
    """Check all settings before any work starts.

    Raises:
        UserError: a setting cannot be used.
    """
    training = config.training
    for name in _AT_LEAST_ONE:
        check_number(f"training.{name}", getattr(training, name), 1)
    for name in _NOT_NEGATIVE:
        check_number(f"training.{name}", getattr(training, name), 0)
    if training.uniform_points + training.surface_points == 0:
        raise UserError(
            "training.uniform_points, training.surface_points: wanted at least one point, got 0 and 0; set one of them"
        )
    check_number("training.learning_rate", training.learning_rate, 0, 1)
    check_number("training.final_learning_rate", training.final_learning_rate, 0, 1)
    check_number("training.average_decay", training.average_decay, 0, 1)
    check_choice("training.precision", training.precision, PRECISIONS)
    check_choice("training.graph", training.graph, GRAPHS)
    check_choice("training.joint_target", training.joint_target, JOINT_TARGETS)
    check_choice("shape.name", config.shape.name, ("mlp", "grid"))
    if (config.shape.name == "grid") != bool(config.shape.feature_cells_m):
        cells = config.shape.feature_cells_m
        wanted = "at least one number for shape=grid" if not cells else "none for shape=mlp, which has no feature grids"
        raise UserError(f"shape.feature_cells_m: wanted {wanted}, got {cells}; give shape=grid")
    check_choice("condition.name", config.condition.name, CONDITIONS)
    for name in ("width", "depth"):
        check_number(f"shape.{name}", getattr(config.shape, name), 1)
    if config.condition.name != "none":
        check_number("condition.layer", config.condition.layer, 0, config.shape.depth - 1)
        for name, size in (("condition.size", config.condition.size), ("shape.condition_size", config.shape.condition_size)):
            check_number(name, size, 1)
    check_choice("model.name", config.model.name, SYSTEMS)
    for name, least in _LEAST_OF_MODEL.items():
        check_number(f"model.{name}", getattr(config.model, name), least)
    if config.model.name == "snarf" and config.search.name != "broyden":
        raise UserError(
            f"search: wanted snarf or broyden with model=snarf, got {config.search.name}; give one of them, or leave search out"
        )
    check_skinning(config.skinning, config.search)
    if config.model.name != "fast_snarf" and config.skinning.name == "preset":
        raise UserError(
            f"skinning={config.skinning.name} is for model=fast_snarf, got model={config.model.name}; leave skinning out"
        )
    check_search(config.search)
    check_number("seed", config.seed, 0)
