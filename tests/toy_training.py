"""Small settings and samples for tests that train: the bending capsule of `toy_subject`, a grid and networks of its size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from toy_subject import toy_subject

from snarfcli.avatar import Avatar
from snarfcli.deformer import BodySkinningConfig, CanonicalGrid, SearchConfig
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings
from snarfcli.shape import ConditionConfig, ShapeConfig
from snarfcli.training.rough_shape import rough_canonical_points
from snarfcli.training.settings import TrainingConfig


def toy_store(root: Path, points: int = 800, frames: int = 34) -> SampleStore:
    """Make and open the samples of the toy subject under `root`."""
    sampling = SamplingSettings(points_per_frame=points, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
    preprocess_subject(toy_subject(train_frames=frames), root, sampling, {"train": 1, "test": 1, "ood": 1})
    return SampleStore.open(root, "builtin", "toy")


def avatar_config(*, capsules: bool = False, condition: str = "global", **search: object) -> AvatarConfig:
    """Return networks that train in seconds; with `capsules` the initial shape is a capsule around the only bone."""
    skinning = BodySkinningConfig(
        resolution=[16, 12, 8], margin_m=[0.05, 0.05, 0.05], width=32, depth=2, weight_norm=False, prior_falloff_m=0.03
    )
    shape = ShapeConfig(
        width=32, depth=3, activation="relu", skip_layers=[], frequencies=[4.0], condition_layer=2, condition_size=4,
        condition_at_start=False, geometric_init=not capsules, weight_norm=False, prior_radius_m=0.07 if capsules else None,
    )  # fmt: skip
    return AvatarConfig(ModelConfig(), skinning, SearchConfig(**search), shape, ConditionConfig(condition))


def training_config(**changes: object) -> TrainingConfig:
    """Return settings of a short training."""
    config = TrainingConfig(
        name="toy", steps=150, poses_per_step=3, uniform_points=200, surface_points=200, far_points=20, fresh_points=False,
        workers=0, graph="auto", agreement_weight=0.0, agreement_points=200, agreement_every=2, learning_rate=1e-2,
        feature_rate=3.0, final_learning_rate=0.05,
        warmup_steps=5, average_decay=0.95, bootstrap_steps=50, bone_occupancy_weight=0.1,
        bone_points=5, joint_weight=1.0, joint_target="halves", refresh_cells_every=40,
        extend_weights_every=60, refine_poses=False, precision="highest",
        validate_every=75, validation_frames=2, checkpoint_every=50,
    )  # fmt: skip
    return replace(config, **changes)


def new_avatar(store: SampleStore, config: AvatarConfig | None = None) -> Avatar:
    """Return an untrained avatar of the store's subject."""
    config = config or avatar_config()
    surface = rough_canonical_points(store)
    grid = CanonicalGrid.around(surface, config.skinning.margin_m)
    return Avatar(config, store.skeleton, grid, surface, {"data": "builtin", "subject": "toy"})
