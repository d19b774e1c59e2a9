"""Flowcharts of Mermaid as SVG pictures inside a page: the site loads no script to draw them.

Only what docs/architecture.md uses is understood: `a & b --> c & d`, dashed arrows `-.->`, and titles such as `c[("text")]`.
"""

from __future__ import annotations

import re
from html import escape

__all__ = ["draw_graphs"]

_BLOCK = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_ARROW = re.compile(r"\s*(-->|-\.->)\s*")
_NODE = re.compile(r'(\w+)(?:\[\("(.*?)"\)\])?$')
_WIDTH, _ROW, _HEIGHT = 860, 74, 30


def draw_graphs(markdown: str) -> str:
    """Return a page with a picture in the place of each flowchart."""
    return _BLOCK.sub(lambda match: _svg(*_read(match.group(1))), markdown)


def _read(text: str) -> tuple[dict[str, str], list[tuple[str, str, bool]]]:
    """Return the titles of the nodes, and the arrows: from, to, and whether dashed."""
    titles: dict[str, str] = {}
    arrows: list[tuple[str, str, bool]] = []
    for line in text.splitlines()[1:]:
        parts = _ARROW.split(line.strip())
        groups = [[_node(name, titles) for name in part.split(" & ")] for part in parts[::2]]
        for before, mark, after in zip(groups, parts[1::2], groups[1:], strict=False):
            arrows += [(one, other, mark == "-.->") for one in before for other in after]
    return titles, arrows


def _node(text: str, titles: dict[str, str]) -> str:
    match = _NODE.match(text.strip())
    if match is None:
        raise ValueError(f'flowchart: wanted a name or name[("title")], got {text!r}')
    name, title = match.groups()
    titles[name] = title or titles.get(name, name)
    return name


def _rows(titles: dict[str, str], arrows: list[tuple[str, str, bool]]) -> list[list[str]]:
    """Return the nodes in rows: each below all that point to it, in the order of the middle of those."""
    depth = dict.fromkeys(titles, 0)
    for _ in titles:
        for one, other, _ in arrows:
            depth[other] = max(depth[other], depth[one] + 1)
    rows: list[list[str]] = [[] for _ in range(max(depth.values()) + 1)]
    for name in titles:
        rows[depth[name]].append(name)
    place = {name: (number + 0.5) / len(row) for row in rows for number, name in enumerate(row)}
    for row in rows[1:]:
        above = {name: [place[one] for one, other, _ in arrows if other == name] for name in row}
        row.sort(key=lambda name: sum(above[name]) / len(above[name]))
        place |= {name: (number + 0.5) / len(row) for number, name in enumerate(row)}
    return rows


def _svg(titles: dict[str, str], arrows: list[tuple[str, str, bool]]) -> str:
    rows = _rows(titles, arrows)
    centre = {
        name: (_WIDTH * (number + 0.5) / len(row), _ROW * depth + _HEIGHT)
        for depth, row in enumerate(rows)
        for number, name in enumerate(row)
    }
    lines = []
    for one, other, is_dashed in arrows:
        (x1, y1), (x2, y2) = centre[one], centre[other]
        y1, y2 = y1 + _HEIGHT / 2, y2 - _HEIGHT / 2 - 5
        bend = (y2 - y1) / 2
        dash = ' stroke-dasharray="4 4"' if is_dashed else ""
        lines.append(
            f'<path d="M{x1:.0f} {y1:.0f}C{x1:.0f} {y1 + bend:.0f} {x2:.0f} {y2 - bend:.0f} {x2:.0f} {y2:.0f}"{dash}/>'
        )
    boxes = []
    for name, (x, y) in centre.items():
        width = 8 * len(titles[name]) + 20
        boxes.append(
            f'<rect x="{x - width / 2:.0f}" y="{y - _HEIGHT / 2:.0f}" width="{width}" height="{_HEIGHT}" rx="4"/>'
            f'<text x="{x:.0f}" y="{y + 5:.0f}">{escape(titles[name])}</text>'
        )
    arrow = (
        '<marker id="head" orient="auto" markerWidth="7" markerHeight="6" refX="1" refY="3"><path d="M0 0L6 3L0 6z"/></marker>'
    )
    size = f'viewBox="0 0 {_WIDTH} {_ROW * len(rows)}"'
    return (
        f'<svg class="graph" role="img" aria-label="{escape(", ".join(titles.values()))}" {size}>'
        f"<defs>{arrow}</defs><g>{''.join(lines)}</g>{''.join(boxes)}</svg>"
    )
