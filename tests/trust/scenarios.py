"""Small commands on a small body, one after the other, for tests of what crashes, full disks and second processes do."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["SCENARIOS", "Scenario"]

_SUBJECT = ("subject=50002",)
_SAMPLES = ("points_per_frame=64", "data.frame_step=60", "data.test_frame_step=120", "data.ood_frame_step=240", "workers=1")
_SEQUENCES = ("sequences=[knees,chicken_wings,deep_squats]",)
_TINY = (
    "training=smoke", "training.steps=6", "training.checkpoint_every=2", "training.validate_every=3", "training.workers=0",
    "training.bootstrap_steps=2", "training.validation_frames=1", "shape.width=16", "shape.depth=2", "condition.layer=1",
    "skinning=coarse",
)  # fmt: skip
_MOTION = ("motion=knees", "max_frames=3")
_REPRODUCE = (
    "reproduce", "table1", "subjects=[50002]", "systems=[ours-local]", "training=smoke", "figures=false", "max_frames=1",
    "surface_frames=0",
    "extra=[training.steps=4,training.checkpoint_every=2,training.validation_frames=1,training.workers=0,shape.width=16,"
    "shape.depth=2,condition.layer=1,skinning=coarse]",
)  # fmt: skip


@dataclass(frozen=True)
class Scenario:
    """One command, and those that make what it needs."""

    name: str
    arguments: tuple[str, ...]
    needs: tuple[str, ...] = ()
    """Names of the scenarios that come before it."""
    is_slow: bool = False
    """Whether it starts other programs, which takes long."""


_LIST = (
    Scenario("preprocess", ("preprocess", *_SUBJECT, *_SAMPLES, *_SEQUENCES)),
    Scenario("train", ("train", *_SUBJECT, *_TINY, "run=r", "resume=true"), ("preprocess",)),
    Scenario(
        "eval",
        ("eval", *_SUBJECT, "run=r", "surface_frames=1", "surface_resolution=16", "figure_frames=1", "figure_resolution=16"),
        ("preprocess", "train"),
    ),
    Scenario(
        "animate",
        ("animate", *_SUBJECT, "run=r", *_MOTION, "resolution=24", "video_size=64", "processes=1"),
        ("preprocess", "train"),
    ),
    Scenario(
        "export",
        ("export", *_SUBJECT, "run=r", "motion=[knees]", "max_frames=3", "resolution=24", "triangles=500", "morph_targets=2"),
        ("preprocess", "train"),
    ),
    Scenario(
        "export_meshes",
        ("export", *_SUBJECT, "run=r", "motion=[knees]", "max_frames=3", "resolution=24", "triangles=500", "format=obj"),
        ("preprocess", "train"),
    ),
    Scenario(
        "export_vrm",
        ("export", *_SUBJECT, "run=r", "motion=[knees,hips]", "max_frames=2", "resolution=24", "triangles=500", "format=vrm"),
        ("preprocess", "train"),
    ),
    Scenario("reproduce", _REPRODUCE, ("preprocess",), is_slow=True),
)
SCENARIOS = {scenario.name: scenario for scenario in _LIST}
"""The commands that write files, by name. All write below the current folder."""
