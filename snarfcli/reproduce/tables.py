"""The tables of a report, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable, Sequence
from urllib.parse import quote

from snarfcli.reproduce.experiments import Row
from snarfcli.reproduce.papers import paper_numbers
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import COLUMNS, MORE_COLUMNS, Cell, Column, Result, summarise

__all__ = ["csv_table", "markdown_runs", "markdown_table", "more_columns", "order_lines", "plain_table"]

Link = Callable[[Result, str], str | None]
"""Returns the file of a stage (train, id, ood) of a run, relative to the report; None without a file."""


def markdown_table(
    plan: Plan, results: Sequence[Result], link: Link, columns: Sequence[Column] = COLUMNS, subject: str | None = None
) -> str:
    """Return a table with one line per system, followed by the numbers of the paper if it has any.

    Args:
        plan: the plan.
        results: results of all its jobs.
        link: returns the file behind a number of one run; a mean links to the list of its runs.
        columns: columns of the table.
        subject: a subject, or None for the mean over all.
    """
    lines = ["| system | " + " | ".join(column.title for column in columns) + " |", "|---|" + "---|" * len(columns)]
    for row in plan.experiment.rows:
        of_row = _of(results, row, subject)
        cells = [_linked(of_row, summarise(of_row, column), column, link) for column in columns]
        lines.append(f"| {row.label} | " + " | ".join(cells) + " |")
        paper = paper_numbers(plan.experiment.name, row.paper, subject)
        if any(column.key in paper for column in columns):
            cells = [f"*{paper[column.key]:g}*" if column.key in paper else "" for column in columns]
            lines.append("| *— in the paper* | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def markdown_runs(plan: Plan, results: Sequence[Result], link: Link, columns: Sequence[Column] = COLUMNS) -> str:
    """Return a table with one line per run; every number links to its file."""
    lines = ["| run | state | " + " | ".join(column.title for column in columns) + " |", "|---|---|" + "---|" * len(columns)]
    for row in plan.experiment.rows:
        for number, result in enumerate(_of(results, row, None)):
            anchor = f'<a id="{row.key}"></a>' if number == 0 else ""
            cells = [_linked([result], summarise([result], column), column, link) for column in columns]
            name = f"{anchor}{row.label}, {result.job.subject}, seed {result.job.seed}"
            lines.append(f"| {name} | {result.state} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plain_table(plan: Plan, results: Sequence[Result]) -> str:
    """Return the main table for a terminal, without the times of single parts; the papers' numbers in brackets.

    With one subject, the paper's numbers are those of the subject if it reports them, and the means otherwise.
    """
    subject = plan.subjects[0] if len(plan.subjects) == 1 else None
    columns = [column for column in COLUMNS if column.key not in ("search_ms", "shape_ms", "total_ms")]
    rows = [["", *(column.title for column in columns)]]
    for row in plan.experiment.rows:
        of_row, paper = _of(results, row, None), paper_numbers(plan.experiment.name, row.paper, subject)
        texts = [summarise(of_row, column).text(column.digits) for column in columns]
        papers = [f" ({paper[column.key]:g})" if column.key in paper else "" for column in columns]
        rows.append([row.label, *(text + other for text, other in zip(texts, papers, strict=True))])
    widths = [max(len(line[index]) for line in rows) for index in range(len(rows[0]))]
    lines = [
        "  ".join(
            text.ljust(width) if index == 0 else text.rjust(width)
            for index, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in rows
    ]
    if any("(" in text for line in rows[1:] for text in line[1:]):
        lines.append("in brackets: the paper's number, from other data")
    return "\n".join(lines)


def csv_table(plan: Plan, results: Sequence[Result], link: Link) -> str:
    """Return all numbers as CSV: one line per run, per row and subject, per row, and per row of the paper.

    The columns `level` (run, subject, all, paper), `row`, `subject`, `seed`, `state`, `runs`, `counted`, `reason` identify the
    line. Each number is followed by its standard deviation over seeds; missing numbers are empty.
    """
    columns = [*COLUMNS, *more_columns(results)]
    fields = ["level", "row", "label", "subject", "seed", "state", "runs", "counted", "reason"]
    fields += [name for column in columns for name in (column.key, f"{column.key}_sd")]
    out = io.StringIO()
    writer = csv.DictWriter(out, [*fields, "train_file", "id_file", "ood_file"], restval="", lineterminator="\n")
    writer.writeheader()

    def write(level: str, row: Row, some: Sequence[Result], **about: object) -> None:
        cells = {column.key: summarise(some, column) for column in columns}
        numbers = {key: _exact(cell.mean) for key, cell in cells.items()}
        numbers |= {f"{key}_sd": _exact(cell.deviation) for key, cell in cells.items()}
        counts = {"runs": len(some), "counted": sum(result.state == "done" for result in some)}
        writer.writerow({"level": level, "row": row.key, "label": row.label} | counts | numbers | about)

    for row in plan.experiment.rows:
        for result in _of(results, row, None):
            files = {f"{stage}_file": link(result, stage) or "" for stage in ("train", "id", "ood")}
            job, about = result.job, {"state": result.state, "reason": result.reason}
            write("run", row, [result], subject=job.subject, seed=job.seed, **about, **files)
        for subject in plan.subjects:
            write("subject", row, _of(results, row, subject), subject=subject)
        write("all", row, _of(results, row, None))
        for subject in (None, *plan.subjects):
            paper = paper_numbers(plan.experiment.name, row.paper, subject)
            if paper:
                about = {"level": "paper", "row": row.key, "label": row.label, "subject": subject or ""}
                writer.writerow(about | {name: _exact(value) for name, value in paper.items() if name in fields})
    return out.getvalue()


def order_lines(plan: Plan, results: Sequence[Result]) -> list[str]:
    """Return the difference of each system to the next one in the papers' order: surface IoU out of distribution, points."""
    column = next(column for column in COLUMNS if column.key == "surface_ood")
    rows = {row.key: row for row in plan.experiment.rows}
    ordered = [rows[key] for key in plan.experiment.order if key in rows]
    lines = []
    for better, worse in itertools.pairwise(ordered):
        first, second = (summarise(_of(results, row, None), column) for row in (better, worse))
        pair = f"{better.label} over {worse.label}"
        if first.mean is None or second.mean is None or not (_is_whole(first) and _is_whole(second)):
            lines.append(f"{pair}: unknown, since not all runs are done")
            continue
        difference = first.mean - second.mean
        noise = _noise(first, second)
        known = " (one seed: noise unknown)" if noise is None else f", standard deviation over seeds {noise:.1f}"
        verdict = "holds" if difference >= 0 else "within noise" if noise and -difference <= noise else "does not hold"
        lines.append(f"{pair}: {difference:+.1f} points{known}: {verdict}")
    return lines


def more_columns(results: Sequence[Result]) -> list[Column]:
    """Return the further columns for which a run has a number."""
    return [column for column in MORE_COLUMNS if any(column.key in result.values for result in results)]


def _of(results: Sequence[Result], row: Row, subject: str | None) -> list[Result]:
    return [result for result in results if result.job.row == row.key and subject in (None, result.job.subject)]


def _linked(results: Sequence[Result], cell: Cell, column: Column, link: Link) -> str:
    text = cell.text(column.digits)
    if cell.mean is None:
        return text
    target = f"#{results[0].job.row}"
    if len(results) == 1:
        target = quote(link(results[0], column.stage) or "") or target  # a subject can have spaces and brackets in its name
    return f"[{text}]({target})"


def _is_whole(cell: Cell) -> bool:
    return cell.mean is not None and cell.count == cell.runs


def _noise(first: Cell, second: Cell) -> float | None:
    """Return the standard deviation of the difference of two means, from the standard deviations of both."""
    if first.deviation is None or second.deviation is None:
        return None
    return (first.deviation**2 + second.deviation**2) ** 0.5


def _exact(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
