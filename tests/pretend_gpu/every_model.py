"""All that a GPU does for an avatar, for every system and its kinds of fields, each part with a watch of its own.

The bending capsule, few points and coarse lattices: it is about the devices of tensors, not about results.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import product
from pathlib import Path

import torch
from pretend_gpu.device import CUDA, watch
from toy_subject import bending
from toy_training import avatar_config, training_config

from snarfcli.avatar import Avatar
from snarfcli.deformer import CanonicalGrid, PresetWeights, SearchConfig
from snarfcli.evaluation.evaluate import measure_frame
from snarfcli.evaluation.surface_metrics import measure_surfaces
from snarfcli.evaluation.weight_metrics import measure_weights
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.models.trained_field import SYSTEMS
from snarfcli.rendering.animation import Animation
from snarfcli.samples.store import SampleStore
from snarfcli.training.rough_shape import rough_canonical_points
from snarfcli.training.settings import TrainingConfig
from snarfcli.training.trainer import Trainer
from snarfcli.viewer.body import ViewerBody
from snarfcli.viewer.picture import ViewerLook
from snarfcli.viewer.state import ViewerState

__all__ = ["run"]

_RESOLUTION = 16
_REFINED_FROM = 100  # step
_MOST_WAIT_S = 60


def run(kind: str, store: SampleStore, folder: Path) -> None:
    """Train, evaluate, mesh, export, animate and show an avatar of a kind in `test_models`, with files in a folder."""
    trainer = _train(kind, store)
    with watch(f"{kind}: finish"):
        avatar = trainer.finished_avatar()
        avatar.to_dict()
    assert isinstance(avatar, Avatar)
    _evaluate(kind, avatar, store)
    _extract(kind, avatar)
    _animate(kind, avatar, folder)


# ---------------------------------------------------------------- training
def _train(kind: str, store: SampleStore) -> Trainer:
    """Take the first steps, with all that happens between them, and return the trainer."""
    settings = _training(kind)
    with watch(f"{kind}: start"):
        torch.manual_seed(0)
        trainer = Trainer(_avatar(kind, store), store, settings, 0, CUDA)
    for name in ("bootstrap step", "usual step", "step with upkeep"):
        with watch(f"{kind}: {name}"):
            trainer.advance()
    if kind == "refined":
        trainer.step = _REFINED_FROM
        with watch(f"{kind}: step with refined poses"):
            trainer.advance()
    with watch(f"{kind}: validation"):
        trainer.validate()
    with watch(f"{kind}: checkpoint"):
        state = trainer.state()
        other = Trainer(_avatar(kind, store), store, settings, 0, CUDA)
        other.restore(state, "checkpoint.pt")
        other.advance()
    return trainer


def _training(kind: str) -> TrainingConfig:
    """Return settings with all losses, and with upkeep of the grids in step 2."""
    changes = {"agreement_weight": 1.0, "agreement_every": 1, "refresh_cells_every": 2, "extend_weights_every": 2}
    sizes = {"uniform_points": 60, "surface_points": 60, "far_points": 10, "agreement_points": 40, "validation_frames": 1}
    is_grids = kind == "grids"
    return training_config(
        **changes, **sizes, bootstrap_steps=1, refine_poses=kind == "refined", fresh_points=is_grids,
        precision="bfloat16" if is_grids else "highest",
    )  # fmt: skip


def _avatar(kind: str, store: SampleStore) -> Avatar:
    """Return an untrained avatar on the CPU, as training begins with it."""
    config = _config(kind)
    surface = rough_canonical_points(store)
    grid = CanonicalGrid.around(surface, config.skinning.margin_m)
    field = None
    if kind == "preset":
        width, height, depth = config.skinning.resolution
        field = PresetWeights.placeholder(grid, (depth, height, width), store.skeleton.num_joints)
    return Avatar(
        config, store.skeleton, grid, surface, {"data": "builtin", "subject": "toy"}, field=field, template=store.template
    )


def _config(kind: str) -> AvatarConfig:
    config = avatar_config(capsules=True, condition="local" if kind == "local" else "global")
    skinning = replace(config.skinning, resolution=[8, 6, 5])
    if kind in ("voxel", "grids"):
        skinning = replace(skinning, name="voxel", softmax="hierarchical", smoothness=1e-3, prior_falloff_m=0.05)
    if kind == "preset":
        skinning = replace(skinning, name="preset", prior_falloff_m=None)
    shape = replace(config.shape, feature_cells_m=[0.2, 0.1], features=2) if kind == "grids" else config.shape
    is_searched = kind in ("snarf", "broyden")
    search = SearchConfig("broyden", max_steps=8) if is_searched else config.search
    model = ModelConfig(kind if kind in SYSTEMS else "fast_snarf", blend="probability" if kind == "broyden" else "logit")
    return AvatarConfig(model, skinning, search, shape, config.condition)


# ---------------------------------------------------------------- use
def _evaluate(kind: str, avatar: Avatar, store: SampleStore) -> None:
    sequence = store.sequences("ood")[0]
    with watch(f"{kind}: evaluation"):
        measure_frame(avatar, sequence, 0)
    with watch(f"{kind}: metrics of surfaces and weights"), suppress(EmptySurface, FullSurface):
        measure_weights(avatar, store.template)
        measure_surfaces(avatar, [sequence], 1, _RESOLUTION)
    pose, points, translation = torch.zeros(1, avatar.skeleton.num_joints, 3), torch.zeros(1, 9, 3), torch.zeros(1, 3)
    for places in product((torch.device("cpu"), CUDA), repeat=3):
        names = ", ".join("GPU" if place == CUDA else "CPU" for place in places)
        with watch(f"{kind}: queries with points, pose and translation on {names}"):
            placed = [tensor.to(place) for tensor, place in zip((points, pose, translation), places, strict=True)]
            avatar.occupancy(*placed)
            avatar.query(placed[0], avatar.bone_transforms(*placed[1:]), placed[1])


def _extract(kind: str, avatar: Avatar) -> None:
    pose = torch.full((avatar.skeleton.num_joints, 3), 0.1)
    for name, given in (("CPU", pose), ("GPU", pose.to(CUDA))):
        with watch(f"{kind}: mesh of a pose on the {name}"):
            _extracted(lambda given=given: avatar.mesh(given, torch.zeros(3, device=CUDA), resolution=_RESOLUTION))
    if avatar.has_skinning_weights:
        with watch(f"{kind}: skinned mesh"):
            _extracted(lambda: avatar.mesh(pose, resolution=_RESOLUTION, surface="skinned"))
            points = torch.zeros(5, 3)
            avatar.canonical_logits(points, pose)
            avatar.skin(points, avatar.bone_transforms(pose[None])[0])
            avatar.skinning_weights(points)


def _extracted(extract: Callable[[], object]) -> None:
    """Extract a surface; an untrained field may have none, which is known once it was evaluated."""
    with suppress(EmptySurface, FullSurface):
        extract()


def _animate(kind: str, avatar: Avatar, folder: Path) -> None:
    motion = bending("bend", 2, 0.5)
    for surface in ("field", "skinned") if avatar.has_skinning_weights else ("field",):
        with watch(f"{kind}: animation of the {surface} surface"):
            moved = Animation(
                avatar, motion.name, motion.poses, motion.translation, [0, 1], surface=surface, resolution=_RESOLUTION,
                folder=folder, suffix="ply", weight_colors=avatar.has_skinning_weights and surface == "skinned",
            )  # fmt: skip
            moved.make(0)
    if avatar.has_skinning_weights:
        with watch(f"{kind}: export"):
            file = folder / f"{kind}.glb"
            _extracted(lambda: avatar.export_glb(file, motion, triangles=200, morph_targets=2, resolution=_RESOLUTION))
    with watch(f"{kind}: viewer"):
        _show(avatar)


def _show(avatar: Avatar) -> None:
    """Let the viewer make its first surfaces, in a thread of its own."""
    woken = threading.Event()
    look = ViewerLook(skinned_resolution=_RESOLUTION, field_resolution=_RESOLUTION)
    state = ViewerState(ViewerBody(avatar), look, woken.set, lambda: 0.0)
    try:
        while state.picture()[0].is_computing:
            assert woken.wait(_MOST_WAIT_S)
            woken.clear()
    finally:
        state.stop()
