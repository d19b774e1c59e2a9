"""The numbers that the papers report, as facts in `papers.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf

__all__ = ["paper_numbers", "paper_source"]


def paper_numbers(table: str, system: str | None, subject: str | None = None) -> dict[str, float]:
    """Return the numbers of a system in a paper's table, by our column names; empty if the paper has none.

    Args:
        table: table1 or table2; any other name has no numbers.
        system: name of the row in `papers.yaml`.
        subject: a subject of DFaust, or None for the mean over all ten.

    Returns:
        IoU in percent, times for 200,000 points in milliseconds, training in minutes.
    """
    content = _content().get(table, {})
    if subject is None:
        return dict(content.get("mean", {}).get(system, {}))
    values = content.get("subjects", {}).get(subject, {}).get(system)
    return {} if values is None else dict(zip(content["iou_columns"], values, strict=True))


def paper_source(table: str) -> str | None:
    """Return the source of the numbers of a table."""
    return _content().get(table, {}).get("source")


@cache
def _content() -> dict[str, Any]:
    content = OmegaConf.to_container(OmegaConf.load(Path(__file__).with_name("papers.yaml")))
    return cast(dict[str, Any], content)
