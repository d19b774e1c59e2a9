"""The figures of a report: which ones an experiment has, in their order."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from snarfcli.errors import UserError
from snarfcli.reproduce.frame_figures import draw_frames
from snarfcli.reproduce.line_figures import draw_sequences, draw_training
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import Result
from snarfcli.reproduce.stick2d_runs import draw_stick_curves, draw_stick_shapes
from snarfcli.reproduce.system_figures import draw_systems, draw_weights

__all__ = ["draw_figures"]

log = logging.getLogger(__name__)

Figure = tuple[Path, str]
"""File and caption."""

_OF_BODIES = ("training", "sequences", "frames")
_FIGURES = {
    "table1": ("systems", "weights", *_OF_BODIES),
    "table2": ("weights", *_OF_BODIES),
    "ablations": _OF_BODIES,
    "minutes": _OF_BODIES,
    "stick2d": ("shapes", "curves", "training"),
    "clothed": ("systems", *_OF_BODIES),
}
"""Names of the figures of each experiment; each is also the name of its file, without the ending."""


def draw_figures(plan: Plan, results: Sequence[Result], folder: Path, resolution: int) -> list[Figure]:
    """Draw the figures of an experiment; one that cannot be drawn is left out with a warning.

    Args:
        plan: the plan.
        results: results of its runs, also of those that are not done.
        folder: folder for the pictures.
        resolution: voxels along the longest side of drawn meshes.

    Returns:
        Files and captions.
    """
    draw: dict[str, Callable[[], Figure | None]] = {
        "systems": lambda: draw_systems(plan, results, folder, resolution),
        "weights": lambda: draw_weights(plan, results, folder, resolution),
        "frames": lambda: draw_frames(plan, results, folder, resolution),
        "sequences": lambda: draw_sequences(plan, results, folder),
        "training": lambda: draw_training(plan, results, folder),
        "shapes": lambda: draw_stick_shapes(plan, results, folder),
        "curves": lambda: draw_stick_curves(plan, results, folder),
    }
    drawn = []
    for name in _FIGURES[plan.experiment.name]:
        try:
            made = draw[name]()
        except (UserError, ValueError, OSError) as error:
            log.warning("warning: cannot draw the figure %s: %s", name, error)
            continue
        if made is not None:
            drawn.append(made)
    return drawn
