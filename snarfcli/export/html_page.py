"""A page of HTML that holds a character and what shows it; it loads nothing and sends nothing.

The scripts are allowed by their digests in the page's Content-Security-Policy, so nothing else in it can run, and the browser
refuses every connection. Texts from files are escaped on their way in.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import snarfcli
from snarfcli.texts import html_text

__all__ = ["PageTexts", "page_of", "room_in_page"]

_SLOT = re.compile(r"\{\{(\w+)\}\}")
_SCRIPTS = {"three": "three.min.js", "viewer": "viewer.js"}
_STYLE = "page.css"
_LONGEST = 300
_SPARE = 20_000  # bytes for texts, the policy, names of clips and bones


@dataclass(frozen=True)
class PageTexts:
    """What a page says about its avatar, in plain text from anywhere."""

    title: str
    size: str
    """Facts about what is shown."""
    license: str


def page_of(character: bytes, texts: PageTexts, facts: Mapping[str, Any]) -> bytes:
    """Return the page of a character.

    Args:
        character: content of a `.glb` file.
        texts: what the page says.
        facts: `clips`, their names, and `bones`, their names and colours; any texts.
    """
    scripts = {slot: _part(name) for slot, name in _SCRIPTS.items()}
    style = _part(_STYLE)
    slots = {
        "policy": _policy(scripts.values(), style),
        "generator": f"snarf {snarfcli.__version__}",
        "title": html_text(texts.title, _LONGEST),
        "size": html_text(texts.size, _LONGEST),
        "license": html_text(texts.license, _LONGEST),
        "style": style,
        "facts": json.dumps(facts).replace("<", "\\u003c"),  # nothing in a text can end the element
        "avatar": base64.b64encode(gzip.compress(character, 9, mtime=0)).decode(),
        **scripts,
    }
    return _SLOT.sub(lambda slot: slots[slot[1]], _part("page.html")).encode()


def room_in_page(most_bytes: int) -> int:
    """Return the number of bytes of a character that certainly fits into a page, even if it cannot be compressed."""
    own = sum(len(_part(name).encode()) for name in (*_SCRIPTS.values(), _STYLE, "page.html"))
    return (most_bytes - own - _SPARE) * 3 // 4  # base64


def _policy(scripts: Iterable[str], style: str) -> str:
    """Return the Content-Security-Policy of a page: its own scripts and style, and nothing else."""
    rules = {
        "default-src": "'none'",
        "script-src": " ".join(map(_digest, scripts)),
        "style-src": _digest(style),
        "img-src": "data:",  # the icon, which browsers would ask a server for
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {sources}" for name, sources in rules.items())


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _part(name: str) -> str:
    """Return a file of the page."""
    return (files("snarfcli.export") / "page" / name).read_text(encoding="utf-8")
