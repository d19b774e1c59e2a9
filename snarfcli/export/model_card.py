"""The model card of an avatar that is passed on: what it is, how well it does, and the licence of its data."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

from snarfcli.datasets.licenses import license_of
from snarfcli.descriptions import DescriptionError, check_plain
from snarfcli.errors import UserError
from snarfcli.files import read_json
from snarfcli.models.trained_field import TrainedField
from snarfcli.texts import markdown_text, plain_markdown

__all__ = ["evaluations", "model_card"]

log = logging.getLogger(__name__)

_SPLITS = (("in distribution", "eval_id"), ("out of distribution", "eval_ood"))
_COLUMNS = (("IoU bbox", "iou_bbox"), ("IoU surface", "iou_surface"), ("worst frame, surface", "worst_iou_surface"))


def model_card(avatar: TrainedField, run: Path | None, license: str | None) -> str:
    """Return the model card of an avatar, in Markdown with a head for model hubs. Texts from files are escaped.

    Args:
        avatar: the avatar.
        run: its run folder with the results of `snarf eval`, if there is one. Results of another avatar are left out.
        license: a sentence; None for that of the data set.
    """
    facts = avatar.facts
    known = license_of(facts)
    identifier = known.identifier if license is None else "other"
    subject = markdown_text(facts.get("subject", "unknown"))
    rows = list(_rows(run, facts).values())
    table = [
        f"| | frames | {' | '.join(title for title, _ in _COLUMNS)} |",
        f"|---|---|{'---|' * len(_COLUMNS)}",
        *rows,
    ]
    joints = avatar.skeleton.num_joints
    return "\n".join(
        [
            "---",
            f"license: {identifier}",
            "library_name: snarf",
            "tags: [avatar, neural-field, skinning, occupancy]",
            "---",
            "",
            f"# Avatar of {subject}",
            "",
            f"An animatable avatar of one subject: an occupancy field that follows a skeleton of {joints} joints, "
            "learned by `snarf` from posed meshes, without skinning weights.",
            "",
            "```python",
            "import torch",
            "from snarf import Avatar",
            "",
            'avatar = Avatar.from_pretrained("FOLDER")  # or the name of its repository: owner/name',
            f"pose = torch.zeros(1, {joints}, 3)  # axis-angle, radians, global orientation first",
            "inside = avatar.occupancy(torch.rand(1, 1000, 3), pose) > 0.5",
            "```",
            "",
            "## Training",
            "",
            *(f"- {title}: {_said(facts.get(name))}" for title, name in _TRAINING if name in facts),
            f"- system: {markdown_text(avatar.config.model.name)}",
            "",
            "## Evaluation",
            "",
            *(table if rows else [_validation(facts)]),
            "",
            *(
                ["Intersection over union with the ground truth, in %, by `snarf eval` and `snarf eval --ood`.", ""]
                if rows
                else []
            ),
            "## Licence",
            "",
            plain_markdown(known.text if license is None else license),
            "",
        ]
    )


_TRAINING = (("data", "data"), ("subject", "subject"), ("preset", "training"), ("steps", "steps"), ("seed", "seed"))


def evaluations(avatar: TrainedField, run: Path | None) -> tuple[str, ...]:
    """Return which evaluations the card of an avatar has: "in distribution", "out of distribution", both or none."""
    return tuple(_rows(run, avatar.facts, log_reasons=False))


def _rows(run: Path | None, facts: dict[str, Any], *, log_reasons: bool = True) -> dict[str, str]:
    """Return the rows of the table by their titles; perhaps log why results are left out."""
    rows = {title: _row(title, run, folder, facts, log_reasons) for title, folder in _SPLITS}
    return {title: row for title, row in rows.items() if row is not None}


def _row(title: str, run: Path | None, folder: str, facts: dict[str, Any], log_reasons: bool) -> str | None:
    """Return the row of one evaluation, or None if there is none of this avatar."""
    path = None if run is None else run / folder / "metrics.json"
    if path is None or not path.is_file():
        return None
    try:
        content = read_json(path, "results of snarf eval")
        check_plain(content, "metrics", finite=False)
    except (UserError, DescriptionError) as error:
        if log_reasons:
            log.warning("%s: left out of the model card (%s)", path, error)
        return None
    if not isinstance(content, dict) or content.get("training") != facts:
        if log_reasons:
            log.warning("%s: left out of the model card, since it is of another avatar; evaluate this one again", path)
        return None
    return f"| {title} | {_said(content.get('frames'))} | {' | '.join(_percent(content.get(name)) for _, name in _COLUMNS)} |"


def _validation(facts: dict[str, Any]) -> str:
    """Return what is known from the training alone."""
    validation = facts.get("validation")
    bbox = validation.get("iou_bbox") if isinstance(validation, dict) else None
    if not isinstance(bbox, (int, float)):
        return "Not evaluated."
    return f"Not evaluated. IoU bbox in the last validation of the training: {_percent(bbox)} %."


def _said(value: Any) -> str:
    return markdown_text("–" if value is None else value)


def _percent(value: Any) -> str:
    """Return a share in percent, or a dash for anything that is none."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return f"{100 * value:.1f}" if is_number else "–"
