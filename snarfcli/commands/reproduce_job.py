"""`snarf reproduce_job`: one run of a plan. `snarf reproduce` starts it, itself or through Hydra's launchers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import MISSING

from snarfcli.reproduce.planned_jobs import run_planned_job

__all__ = ["ReproduceJobConfig", "run"]


@dataclass
class ReproduceJobConfig:
    """Settings of `snarf reproduce_job`."""

    plan: str = MISSING
    """Plan file that `snarf reproduce` has written."""
    job: int = MISSING
    """Number of the job in the plan."""


def run(config: ReproduceJobConfig) -> None:
    """Run one job; its status is written beside the plan.

    Raises:
        UserError: the plan or the job does not exist.
    """
    run_planned_job(Path(config.plan).absolute(), config.job)
