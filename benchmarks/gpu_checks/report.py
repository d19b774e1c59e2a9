"""What a stage has found, in a JSON file written anew with every result, and the Markdown report of all stages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gpu_checks.goals import GOALS
from snarfcli.files import write_json
from snarfcli.texts import markdown_text, terminal_text

__all__ = ["Section", "empty_section", "markdown", "table_text"]

_MOST_OUTPUT = 4000  # characters of the output of a stage that failed


def empty_section() -> dict[str, Any]:
    """Return the results of a stage that has none yet: parts of text, raw numbers, and values for goals."""
    return {"parts": [], "numbers": {}, "goals": {}}


class Section:
    """The results of one stage; each is in the file as soon as it is known, so that none is lost when the stage is stopped.

    Args:
        path: of the JSON file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.content = path, empty_section()

    def say(self, *sentences: str) -> None:
        """Add a paragraph."""
        self.content["parts"].append({"text": " ".join(sentences)})
        print(self.content["parts"][-1]["text"], flush=True)
        write_json(self.path, self.content)

    def table(self, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Add a table; cells are written as text."""
        cells = [[str(cell) for cell in row] for row in rows]
        self.content["parts"].append({"header": list(header), "rows": cells})
        print(table_text(header, cells), flush=True)
        write_json(self.path, self.content)

    def number(self, name: str, value: float) -> None:
        """Add a raw number under a name, as in "search/near/200000/ms"; NaN, for what failed, becomes null."""
        self.content["numbers"][name] = value if math.isfinite(value) else None
        write_json(self.path, self.content)

    def goal(self, key: str, value: float, note: str = "") -> None:
        """State the measured value of a goal, one of `GOALS`, and where it comes from; NaN if measuring failed."""
        assert key in GOALS, key
        self.content["goals"][key] = {"value": float(value) if math.isfinite(value) else None, "note": note}
        write_json(self.path, self.content)


def table_text(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows of text as a Markdown table."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    padded = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def markdown(results: Mapping[str, Any], titles: Mapping[str, str]) -> str:
    """Return the report of all stages that have run.

    Args:
        results: `name` of the machine, `facts` (text), `is_dry` (goals are not judged), and `stages` by name: status, seconds,
            output and the section's content.
        titles: of the stages, by name, in the order of the report.
    """
    blocks = [f"# {markdown_text(results['name'])}", results["facts"], "## Goals", _goals(results["stages"], results["is_dry"])]
    for name, title in titles.items():
        stage = results["stages"].get(name)
        if stage is not None:
            blocks += [f"## {title}", *_stage(stage)]
    return "\n\n".join(blocks) + "\n"


def _goals(stages: Mapping[str, Any], is_dry: bool) -> str:
    measured: dict[str, Any] = {}
    for stage in stages.values():
        measured |= stage["content"]["goals"]
    rows = []
    for key, goal in GOALS.items():
        found = measured.get(key)
        note = "" if found is None else found["note"].replace("|", "\\|")
        if found is None:
            rows.append([goal.what, goal.wanted, "not run", "", ""])
        elif found["value"] is None:
            rows.append([goal.what, goal.wanted, "failed", "**missed**", note])
        else:
            verdict = "reached" if goal.is_reached(found["value"]) else "**missed**"
            rows.append([goal.what, goal.wanted, f"{found['value']:.4g}", "" if is_dry else verdict, note])
    return table_text(["goal", "wanted", "measured", "", "of"], rows)


def _stage(stage: Mapping[str, Any]) -> list[str]:
    blocks = [
        part["text"] if "text" in part else table_text(part["header"], part["rows"]) for part in stage["content"]["parts"]
    ]
    if stage["status"] == "done":
        return [*blocks, f"({stage['seconds']:.0f} s)"]
    blocks.append(f"**{stage['status']}** after {stage['seconds']:.0f} s; what is missing above was not measured.")
    if stage["output"]:
        blocks.append("```text\n" + terminal_text(stage["output"][-_MOST_OUTPUT:]).replace("```", "'''") + "\n```")
    return blocks
