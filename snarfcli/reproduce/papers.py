"""The numbers that the papers report, as facts in `papers.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

__all__ = ["paper_numbers", "paper_source"]


def paper_numbers(table: str, system: str | None, subject: str | None = None) -> dict[str, float]:
    """Return what a paper's table says of a system, by the names of our columns; nothing where it says nothing.

    Args:
        table: table1 or table2; any other name has no numbers.
        system: name of the row in `papers.yaml`.
        subject: one subject of DFaust, or None for the mean over all ten.

    Returns:
        IoU in percent, times for 200,000 points in milliseconds, training in minutes.
    """
    content = _content().get(table, {})
    if subject is None:
        return dict(content.get("mean", {}).get(system, {}))
    values = content.get("subjects", {}).get(subject, {}).get(system)
    return {} if values is None else dict(zip(content["iou_columns"], values, strict=True))


def paper_source(table: str) -> str | None:
    """Return where the numbers of a table come from."""
    return _content().get(table, {}).get("source")


@cache
def _content() -> dict[str, Any]:
    return OmegaConf.to_container(OmegaConf.load(Path(__file__).with_name("papers.yaml")))  # type: ignore[return-value]
