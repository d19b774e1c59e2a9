"""`snarf reproduce_job`: one run of a plan. Hydra's launchers call it; people call `snarf reproduce`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import MISSING

from snarfcli.reproduce.launching import run_planned_job

__all__ = ["ReproduceJobConfig", "run"]


@dataclass
class ReproduceJobConfig:
    """Settings of `snarf reproduce_job`."""

    plan: str = MISSING
    """The file that `snarf reproduce` wrote."""
    job: int = MISSING
    """Number of the job in it."""


def run(config: ReproduceJobConfig) -> None:
    """Run one job; what becomes of it is written beside the plan.

    Raises:
        UserError: there is no such plan or job.
    """
    run_planned_job(Path(config.plan).absolute(), config.job)
