"""Accuracy of avatars: IoU and its means, tables, reports, and a picture of the worst and the best frames."""

from __future__ import annotations

from snarfcli.evaluation.metrics import FrameMetrics, Summary, iou, summarise

__all__ = ["FrameMetrics", "Summary", "iou", "summarise"]
