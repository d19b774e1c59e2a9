"""Export an avatar and its motions as one HTML file that any browser plays, without a network."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from snarfcli.datasets.licenses import license_of
from snarfcli.errors import UserError
from snarfcli.export.character import Character, CharacterOptions, check_options
from snarfcli.export.character_build import build_character
from snarfcli.export.character_glb import character_glb
from snarfcli.export.character_surface import character_surface, check_avatar
from snarfcli.export.clips import Clip
from snarfcli.export.export import ExportReport, check_output, report_of
from snarfcli.export.html_page import PageTexts, page_of, room_in_page
from snarfcli.export.html_size import MOST_BYTES, PagePlan, plan_page
from snarfcli.files import atomic_path
from snarfcli.meshing.colors import bone_colors
from snarfcli.models.trained_field import TrainedField
from snarfcli.texts import counted, one_line

__all__ = ["HtmlConfig", "export_html"]

log = logging.getLogger(__name__)

_LONGEST_NAME = 80
_COMPRESSION = 2
"""How much smaller a character usually gets by compression; measured: 3.3 for a mesh with short motions."""


@dataclass
class HtmlConfig:
    """What the page says about the avatar."""

    title: str | None = None
    """Title of the page; null for the name of the subject."""
    license: str | None = None
    """Licence of the avatar, a sentence; null for that of the data set."""


def export_html(
    avatar: TrainedField,
    path: str | Path,
    clips: Sequence[Clip],
    options: CharacterOptions,
    texts: HtmlConfig | None = None,
    *,
    name: str | None = None,
    joint_names: Sequence[str] | None = None,
    overwrite: bool = False,
) -> tuple[ExportReport, list[str]]:
    """Write an avatar and its motions as one HTML file of at most 5 MB, whole or not at all.

    Args:
        avatar: an avatar with skinning weights.
        path: the file.
        clips: motions, at least one.
        options: limits on the size of the character. The page always has the colours of the weights.
        texts: title and licence.
        name: name of the avatar; by default its subject.
        joint_names: names of the joints; by default those of the avatar's skeleton.
        overwrite: whether an existing file is replaced.

    Returns:
        Facts about the character, and one line for each thing that was reduced so that the file is small enough. Numbers of
        8 and 16 bits add about 0.1 mm to the deviation of the report.

    Raises:
        UserError: an option is out of range, the file exists, the motions do not fit, or the avatar has no weights or no
            surface.
    """
    check_options(options)
    path, texts = Path(path), texts or HtmlConfig()
    check_output(path, overwrite)
    if not clips:
        raise UserError("clips: wanted at least one motion to export, got none; give a motion")
    check_avatar(avatar)
    name = name or str(avatar.facts.get("subject", "avatar"))
    names = list(joint_names or avatar.skeleton.names)
    room = room_in_page(MOST_BYTES)
    for hope in (_COMPRESSION, 1):
        plan = plan_page(clips, options, len(names), hope * room)
        character = build_character(avatar, character_surface(avatar, plan.options), plan.clips, plan.options)
        report = report_of(path, character, plan.options)
        page = _page(avatar, character, report, texts, name, names)
        if len(page) <= MOST_BYTES:
            break
        log.info("the page would have %.1f MB; it is made again with less", len(page) / 1e6)
    else:
        raise UserError(f"format=html: wanted at most {MOST_BYTES / 1e6:g} MB, got {len(page) / 1e6:.1f}; give fewer motions")
    with atomic_path(path) as temporary:
        temporary.write_bytes(page)
    return report_of(path, character, plan.options, len(page)), _reductions(plan, options, report)


def _page(
    avatar: TrainedField, character: Character, report: ExportReport, texts: HtmlConfig, name: str, names: list[str]
) -> bytes:
    """Return the page of a character whose joints have the given names."""
    builder, _ = character_glb(
        character,
        names,
        avatar.skeleton.parents,
        name=name,
        weight_colors=True,
        compact=True,
        facts={"snarf": report.facts()},
    )
    colors = _css_colors(len(names))
    facts = {
        "clips": [one_line(clip.name, _LONGEST_NAME) for clip in character.clips],
        "bones": [{"name": one_line(joint, _LONGEST_NAME), "color": color} for joint, color in zip(names, colors, strict=True)],
    }
    motions = counted(len(character.clips), "motion")
    size = f"{report.triangles:,} triangles, {counted(report.joints, 'bone')}, {motions}"
    said = PageTexts(texts.title or name, size, f"Licence: {texts.license or license_of(avatar.facts).text}")
    return page_of(builder.to_bytes(), said, facts)


def _reductions(plan: PagePlan, wanted: CharacterOptions, report: ExportReport) -> list[str]:
    """Return what was reduced so that the page is small enough, one line each."""
    lines = []
    if plan.frame_rate is not None:
        lines.append(f"the motions have {plan.frame_rate:g} frames per second, so that they fit into the page")
    most = plan.options.triangles or 0
    is_less = wanted.triangles is None or wanted.triangles > most
    if is_less and report.triangles > 0.99 * most:  # a smaller surface is whole
        lines.append(f"the mesh has {report.triangles} triangles, as many as fit into the page beside the motions")
    return lines


def _css_colors(count: int) -> list[str]:
    """Return the colours of bones as in the project's pictures, for style sheets."""
    return ["#" + "".join(f"{round(255 * part):02x}" for part in color) for color in bone_colors(count)]
