"""`snarf export format=pretrained`: the avatar itself as a folder to be passed on, with a model card."""

from __future__ import annotations

import logging
from pathlib import Path

from snarfcli.commands.export_places import check_place, default_place, subject_name, write_record, writing
from snarfcli.commands.export_settings import ExportConfig
from snarfcli.commands.selection import load_selected_avatar
from snarfcli.export.model_card import evaluations
from snarfcli.export.sequence import atomic_folder
from snarfcli.runs import machine_facts

__all__ = ["write_folder"]

log = logging.getLogger(__name__)


def write_folder(config: ExportConfig) -> int:
    """Write the folder, which appears as a whole, and a record beside it; return 0.

    Raises:
        UserError: the avatar does not exist, or the folder cannot be written.
    """
    if config.output is not None:  # before the avatar is loaded
        check_place(config, Path(config.output))
    avatar, path = load_selected_avatar(config)
    place = Path(config.output) if config.output else default_place(config, path.parent, subject_name(config, avatar))
    output = check_place(config, place)
    log.info("avatar: %s", path)
    shown = evaluations(avatar, path.parent)
    with writing(config, output):
        with atomic_folder(output) as folder:
            avatar.save_pretrained(folder, run=path.parent, license=config.pretrained.license)
            size = sum(file.stat().st_size for file in folder.iterdir())
        facts = {"avatar": str(path), "folder": output.name, "bytes": size, "evaluations": list(shown)}
        write_record(config, output, {**facts, **machine_facts()})
    if shown:
        log.info("the model card contains the IoU %s", " and ".join(shown))
    else:
        log.info('the model card has no evaluation: run "snarf eval" and "snarf eval --ood" first, to add them')
    log.info("%s: %.2f MB; Avatar.from_pretrained and ckpt=FOLDER read it", output, size / 1e6)
    return 0
