"""Links of a Markdown file of the project, as they are on the site."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Mapping

__all__ = ["rewrite_links"]

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^()\s]+)\)")
_CODE = re.compile(r"^((?s:(````?)\w*\n.*?^\2)$|(?:(?: {4}[^\n]*)?\n)+)", re.MULTILINE)  # fenced or indented


def rewrite_links(markdown: str, source: str, site: str, pages: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return a page with links to pages of the site, and the files that it links to and the site does not have.

    Args:
        markdown: text of the page.
        source: file of the page in the project.
        site: file of the page among those of the site.
        pages: pages of the site for files that are not in docs/, by file.
    """
    lost: list[str] = []

    def rewritten(match: re.Match[str]) -> str:
        mark, text, target = match.groups()
        path, hash_sign, anchor = target.partition("#")
        if "://" in target or target.startswith("mailto:") or not path:
            return match.group(0)
        file = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        page = pages.get(file) or (file.removeprefix("docs/") if file.startswith("docs/") else None)
        if page is None:
            lost.append(file)
            return text
        place = posixpath.relpath(page, posixpath.dirname(site) or ".")
        return f"{mark}[{text}]({place}{hash_sign}{anchor})"

    result, start = [], 0
    for code in _CODE.finditer(markdown):
        result += [_LINK.sub(rewritten, markdown[start : code.start()]), code.group(0)]
        start = code.end()
    return "".join([*result, _LINK.sub(rewritten, markdown[start:])]), lost
