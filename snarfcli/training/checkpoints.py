"""What a checkpoint of a training is checked for before the training continues from it."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from snarfcli.descriptions import DescriptionError, check_plain
from snarfcli.errors import UserError
from snarfcli.models.settings import AvatarConfig
from snarfcli.texts import one_line
from snarfcli.training.settings import TrainingConfig

__all__ = [
    "CHECKPOINT_FORMAT",
    "CHECKPOINT_VERSION",
    "check_same_settings",
    "checked_code",
    "checked_seconds",
    "checked_step",
    "checked_validations",
]

CHECKPOINT_FORMAT = "snarf-checkpoint"
CHECKPOINT_VERSION = 2

# Settings that do not change the avatar, so that a training may continue with other values.
_MAY_DIFFER = ("workers", "graph", "validate_every", "validation_frames", "validation_ood_frames", "checkpoint_every")


def check_same_settings(state: dict[str, Any], avatar: AvatarConfig, training: TrainingConfig, seed: int, path: str) -> None:
    """Compare the settings of a checkpoint with those of a run; `path` names the checkpoint in messages.

    Raises:
        UserError: they differ, or there are none.
    """
    settings = asdict(training)
    same = {name: settings[name] for name in _MAY_DIFFER}
    ours = asdict(avatar) | {"training": settings, "seed": seed}
    try:
        theirs = state["avatar"]["config"] | {"training": state["training"] | same, "seed": state["seed"]}
        check_plain(theirs, "settings")
    except (KeyError, TypeError, DescriptionError):
        raise UserError(f"{path} is incomplete; start again with overwrite=true") from None
    changed = _differences(theirs, ours)
    if changed:
        raise UserError(
            f"{path} was made with other settings ({', '.join(changed[:4])}); give the same settings to resume, "
            "overwrite=true to start again, or run=NAME for another folder"
        )


def checked_step(step: Any, last: int) -> int:
    """Return the number of the step in a checkpoint of a training with `last` steps.

    Raises:
        ValueError: it is none of this training.
    """
    if type(step) is not int or not 0 <= step <= last:
        raise ValueError(f"step: wanted 0 to {last}, got another")
    return step


def checked_seconds(seconds: Any) -> float:
    """Return the time in a checkpoint; ValueError if it is none."""
    if type(seconds) not in (int, float) or not 0 <= seconds < math.inf:
        raise ValueError("seconds: wanted a number from 0, got another")
    return float(seconds)


def checked_validations(validations: Any) -> list[dict[str, float]]:
    """Return the validations in a checkpoint; ValueError if they are none."""
    if not isinstance(validations, list):
        raise ValueError("validations: wanted a list, got another type")
    for one in validations:
        names = ("step", "seconds", "iou_bbox", "iou_surface")
        if not isinstance(one, dict) or not all(_is_number(one.get(name)) for name in names):
            raise ValueError("validations: wanted finite numbers by name, got something else")
        if not all(type(name) is str and _is_number(value) for name, value in one.items()):
            raise ValueError("validations: wanted finite numbers by name, got something else")
    return validations


def checked_code(versions: Any) -> list[dict[str, str]]:
    """Return the versions of the code in a checkpoint; ValueError if they are none."""
    if not isinstance(versions, list) or not all(isinstance(one, dict) for one in versions):
        raise ValueError("code: wanted a list of versions, got something else")
    if not all(type(name) is str and type(value) is str for one in versions for name, value in one.items()):
        raise ValueError("code: wanted texts by name, got something else")
    return versions


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _differences(theirs: Any, ours: Any, prefix: str = "") -> list[str]:
    """Return the dotted names under which two nested dicts differ, with both values."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        names = sorted(set(theirs) | set(ours))
        parts = [_differences(theirs.get(n), ours.get(n), f"{prefix}.{n}" if prefix else n) for n in names]
        return [line for part in parts for line in part]
    return [] if theirs == ours else [one_line(f"{prefix}: {str(theirs)[:60]} there, {ours} here")]
