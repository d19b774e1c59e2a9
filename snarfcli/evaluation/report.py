"""Report of an evaluation: the table on the terminal and the content of `metrics.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from snarfcli.evaluation.metrics import FrameMetrics, Summary, group_by_sequence, mean_of_sequences, summarise
from snarfcli.texts import counted

__all__ = [
    "PROTOCOL",
    "REFERENCE_POINTS",
    "SPLITS",
    "STORE_SPLITS",
    "EvaluationReport",
    "metrics_content",
    "plain",
    "table",
    "timings_text",
]

SPLITS = {"id": "in distribution", "ood": "out of distribution"}
"""Splits that can be evaluated: held-out motion like that of the training, and poses unlike it."""
STORE_SPLITS = {"id": "test", "ood": "ood"}
"""Names of these splits in the samples."""

REFERENCE_POINTS = 200_000
"""Number of points for which the papers' table states times (Fast-SNARF table 1)."""

PROTOCOL = {
    "iou_bbox": "uniform points in the cube around the posed mesh, longest side x 1.1",
    "iou_surface": "points near the surface",
    "iou_tight_box": "the uniform points that lie in the tight box of the posed mesh",
    "averaging": "mean over all frames of the IoU of each frame; a sequence's value is the mean over its frames",
    "empty_sets": "the IoU of two empty sets is 1",
    "correspondences_per_point": "mean over points that have any; several_correspondences: share of points with two or more",
    "without_correspondence": "shares of the points of all frames together",
    "weights": "at the vertices of the body's mesh in the canonical pose, against its own; wrong_share: half the sum "
    "of the absolute differences over bones; right_bone: share of vertices whose heaviest bone is the same; "
    "precision, recall: of a vertex's influences (weights above 0.01), mean over vertices; l1_norm: twice wrong_share",
    "surfaces": "Chamfer: mean of the two mean distances; normals: mean cosine at nearest places; F-score: within 5 mm",
    "timings": "one untimed call first; times for 200,000 points are scaled from calls of points_per_frame points",
}
"""Definitions of the numbers, as stated in `metrics.json`."""

_NAME_WIDTH = 30  # longer names of sequences are cut; the table fits 100 columns


@dataclass(frozen=True)
class EvaluationReport:
    """The measured frames of one avatar on one split, and facts about them."""

    data: str
    """Name of the data set."""
    subject: str
    """Name of the subject."""
    model: str
    """Name of the system."""
    split: str
    """One of `SPLITS`."""
    frames: Sequence[FrameMetrics]
    """Measured frames, sequence by sequence."""
    wall_s: float
    """Seconds for the whole evaluation, reading included."""
    machine: Mapping[str, Any]
    """`versions` and `machine`, see `snarfcli.runs.machine_facts`."""
    device: str = "cpu"
    """Device on which the avatar computed."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """Facts about the avatar's training."""
    search: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the correspondence search."""
    refined_poses: Mapping[str, float] | None = None
    """How much the poses of the frames were changed to fit their meshes, see `RefinedPoses.summary`; None for given poses."""
    samples: Mapping[str, Any] = field(default_factory=dict)
    """Settings with which the samples were made."""

    @property
    def title(self) -> str:
        """System, subject, data set and split, and whether the poses were fitted to the meshes."""
        title = f"{self.model} of subject {self.subject}, data {self.data}, {SPLITS[self.split]} ({self.split})"
        return title if self.refined_poses is None else f"{title}, poses fitted to the meshes"


def table(evaluation: EvaluationReport) -> str:
    """Return the table of an evaluation: one row per sequence, then the means; IoU and shares in percent."""
    groups = {name: summarise(frames) for name, frames in group_by_sequence(evaluation.frames).items()}
    overall = summarise(evaluation.frames)
    width = min(_NAME_WIDTH, max(len(name) for name in [*groups, "mean of sequences"]))
    head = f"{'':{width}}  {'':6}  {'IoU %':^31}    no correspondence %"
    names = f"{'sequence':{width}}  frames  {'bbox':>6}  {'surface':>7}  {'tight':>6}  {'worst':>6}"
    names += f"    {'all':>8}  {'inside':>9}"
    rule = "-" * len(names)
    lines = [evaluation.title, "", head.rstrip(), names, rule]
    lines += [_row(name, summary, width) for name, summary in groups.items()]
    lines.append(rule)
    if len(groups) > 1:
        means = mean_of_sequences(evaluation.frames)
        lines.append(
            f"{'mean of sequences':{width}}  {'':6}  {100 * means['iou_bbox']:6.2f}  {100 * means['iou_surface']:7.2f}  "
            f"{100 * means['iou_tight_box']:6.2f}"
        )
    lines.append(_row("all frames", overall, width))
    lines += [
        "bbox: the papers' cube; surface: near the surface; tight: the mesh's own box;",
        "worst: lowest surface IoU of a frame",
    ]
    return "\n".join(lines)


def _row(name: str, summary: Summary, width: int) -> str:
    name = name if len(name) <= width else name[: width - 3] + "..."
    return (
        f"{name:{width}}  {summary.frames:6d}  {100 * summary.iou_bbox:6.2f}  {100 * summary.iou_surface:7.2f}  "
        f"{100 * summary.iou_tight_box:6.2f}  {100 * summary.worst_iou_surface:6.2f}    {100 * summary.without:8.2f}  "
        f"{100 * summary.inside_without:9.3f}"
    )


def timings_text(evaluation: EvaluationReport) -> str:
    """Return two lines: times for the number of points of the papers' table; device and total time."""
    times = _timings(evaluation)
    machine = evaluation.machine["machine"]
    threads, frames = counted(machine["threads"], "thread"), counted(len(evaluation.frames), "frame")
    where = machine["gpu"] if times["device"] != "cpu" and "gpu" in machine else threads
    return (
        f"time for {REFERENCE_POINTS:,} points: search {times['search_ms_per_200k']:.1f} ms, "
        f"shape {times['shape_ms_per_200k']:.1f} ms, total {times['total_ms_per_200k']:.1f} ms\n"
        f"{frames} in {evaluation.wall_s:.1f} s on {times['device']}, {where}"
    )


def _timings(evaluation: EvaluationReport) -> dict[str, Any]:
    summary = summarise(evaluation.frames)
    scale = 1000 * REFERENCE_POINTS / max(summary.points, 1)
    seconds = {"search": summary.search_s, "shape": summary.shape_s, "total": summary.total_s}
    return {
        **{f"{name}_s": round(value, 4) for name, value in seconds.items()},
        **{f"{name}_ms_per_200k": round(value * scale, 3) for name, value in seconds.items()},
        "wall_s": round(evaluation.wall_s, 3),
        "points": summary.points,
        "device": evaluation.device,
        "threads": evaluation.machine["machine"]["threads"],
    }


def metrics_content(evaluation: EvaluationReport, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `metrics.json` as plain JSON values; IoU and shares from 0 to 1, times in seconds unless named.

    Args:
        evaluation: the results.
        settings: resolved settings of the command, `seed` included.
    """
    overall = summarise(evaluation.frames)
    groups = group_by_sequence(evaluation.frames)
    content = {
        "data": evaluation.data,
        "subject": evaluation.subject,
        "model": evaluation.model,
        "split": evaluation.split,
        **_values(overall),
        "points_per_frame": evaluation.frames[0].points,
        "mean_of_sequences": mean_of_sequences(evaluation.frames),
        "sequences": {name: _sequence(frames) for name, frames in groups.items()},
        "timings": _timings(evaluation),
        "protocol": PROTOCOL,
        **evaluation.machine,
        "training": dict(evaluation.training),
        "search": dict(evaluation.search),
        "refined_poses": evaluation.refined_poses,
        "samples": dict(evaluation.samples),
        "seed": settings.get("seed"),
        "settings": dict(settings),
    }
    return plain(content)


def _values(summary: Summary) -> dict[str, Any]:
    return {
        "iou_bbox": summary.iou_bbox,
        "iou_surface": summary.iou_surface,
        "iou_tight_box": summary.iou_tight_box,
        "worst_iou_surface": summary.worst_iou_surface,
        "frames": summary.frames,
        "correspondences_per_point": summary.correspondences_per_point,
        "several_correspondences": summary.several,
        "without_correspondence": summary.without,
        "inside_without_correspondence": summary.inside_without,
    }


def _sequence(frames: Sequence[FrameMetrics]) -> dict[str, Any]:
    summary = asdict(summarise(frames))
    times = {name: round(summary[name], 4) for name in ("search_s", "shape_s", "total_s")}
    names = ("frame", "iou_bbox", "iou_surface", "iou_tight_box", "without", "inside", "inside_without")
    per_frame = {name: [getattr(frame, name) for frame in frames] for name in names}
    per_frame = {name: [round(value, 6) for value in values] for name, values in per_frame.items()}
    return {**_values(summarise(frames)), **times, "per_frame": per_frame}


def plain(value: Any) -> Any:
    """Return `value` as plain JSON types: arrays and tensors become lists, paths text, and numbers that are not finite None."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):  # arrays and tensors, scalars too
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    return str(value) if isinstance(value, Path) else repr(value)
