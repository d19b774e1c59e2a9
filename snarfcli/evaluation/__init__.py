"""Accuracy of avatars: IoU and its means, tables, reports, and a figure of the worst and best frames."""

from __future__ import annotations

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.evaluation.metrics import FrameMetrics, Summary, iou, summarise

__all__ = ["FrameMetrics", "Summary", "iou", "summarise"]
