"""What `snarf` alone prints: what to do first, what is already there, and the command that comes next."""

from __future__ import annotations

import shlex
from pathlib import Path

from snarfcli.texts import one_line, terminal_text

__all__ = ["start_page"]

_MOST_SHOWN = 3
_LONGEST_NAME = 60
_SUBJECT = "50002"

_Names = tuple[str, ...]
"""Names of nested folders: data and subject, and the run of an avatar."""


def start_page(data_root: Path = Path("data"), output_root: Path = Path("outputs")) -> str:
    """Return five lines of text.

    Args:
        data_root: folder with the processed samples.
        output_root: folder with the trained avatars.
    """
    samples = _found(data_root / "processed", "*/*/manifest.json")
    avatars = _found(output_root, "*/*/*/avatar.pt")
    lines = (
        'snarf learns an animatable avatar of one subject from posed meshes; "snarf --help" lists all commands.',
        f"First: snarf preprocess subject={_SUBJECT}, then train (with training=quick: a minute or two), eval and animate.",
        f"Samples in {data_root / 'processed'}: {_listed(samples)}",
        f"Avatars in {output_root}: {_listed(avatars)}",
        f"Next: {_next_command(samples, avatars)}",
    )
    return "\n".join(terminal_text(line) for line in lines)


def _found(root: Path, pattern: str) -> list[_Names]:
    """Return the folders of the files that match a pattern, the newest file first."""
    found: list[tuple[float, _Names]] = []
    for path in root.glob(pattern):
        try:
            changed = path.stat().st_mtime
        except OSError:  # deleted meanwhile, or not to be read
            continue
        found.append((-changed, path.parent.relative_to(root).parts))
    return [names for _, names in sorted(found)]


def _listed(found: list[_Names]) -> str:
    """Return the first of several things as text, and the number of the others."""
    if not found:
        return "none yet"
    shown = ", ".join(one_line("/".join(names), _LONGEST_NAME) for names in found[:_MOST_SHOWN])
    return shown if len(found) <= _MOST_SHOWN else f"{shown} and {len(found) - _MOST_SHOWN} more"


def _next_command(samples: list[_Names], avatars: list[_Names]) -> str:
    """Return the command that comes next for the newest avatar, or else for the newest samples."""
    if avatars:
        data, subject, run = avatars[0]
        return f"snarf animate {_settings(data, subject)}{_setting('run', run, 'fast_snarf')}"
    if samples:
        return f"snarf train {_settings(*samples[0])} training=quick"
    return f"snarf preprocess subject={_SUBJECT}"


def _settings(data: str, subject: str) -> str:
    """Return the settings that select a subject."""
    return f"{_setting('data', data, 'builtin')} subject={_quoted(subject)}".lstrip()


def _setting(name: str, value: str, usual: str) -> str:
    return "" if value == usual else f" {name}={_quoted(value)}"


def _quoted(value: str) -> str:
    return shlex.quote(one_line(value))
