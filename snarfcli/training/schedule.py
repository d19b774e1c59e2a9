"""What depends on the number of a step: learning rate, and which losses and updates are due."""

from __future__ import annotations

import math
from dataclasses import dataclass

from snarfcli.training.settings import TrainingConfig

__all__ = ["StepKind", "is_due", "kind_of", "learning_rate"]


@dataclass(frozen=True)
class StepKind:
    """Which losses a step has beside those of every step."""

    bootstraps: bool
    """The losses that fill the bones and tie the joints to them."""
    agrees: bool
    """The loss for made-up poses."""


def kind_of(config: TrainingConfig, step: int) -> StepKind:
    """Return the kind of a step."""
    agrees = config.agreement_weight > 0 and is_due(step, config.agreement_every)
    return StepKind(step < config.bootstrap_steps, agrees)


def is_due(step: int, every: int) -> bool:
    """Return whether a step is one of every `every`; 0 is never."""
    return every > 0 and step > 0 and step % every == 0


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Return the learning rate of a step: linear warm-up, then a cosine down to the final rate."""
    warm = min(1.0, (step + 1) / max(config.warmup_steps, 1))
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, step / max(config.steps, 1))))
    return config.learning_rate * warm * (config.final_learning_rate + (1 - config.final_learning_rate) * cosine)
