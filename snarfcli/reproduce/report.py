"""The report of an experiment: tables, figures and the files behind the numbers, in one self-contained folder."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import snarfcli
from snarfcli.files import atomic_path, write_json
from snarfcli.reproduce.figures import draw_figures
from snarfcli.reproduce.papers import paper_source
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.provenance import provenance_lines, provenance_sections
from snarfcli.reproduce.results import COLUMNS, NOT_RUN, Result, read_metrics
from snarfcli.reproduce.tables import csv_table, markdown_runs, markdown_table, more_columns, order_lines
from snarfcli.texts import counted, plain_markdown

__all__ = ["write_report"]

_COPIES = {"train": "train.json", "id": "eval_id.json", "ood": "eval_ood.json"}


def write_report(
    plan: Plan,
    results: Sequence[Result],
    folder: Path,
    command: str,
    *,
    about: str = "",
    figure_resolution: int | None = None,
    is_growing: bool = False,
) -> list[Path]:
    """Write `<experiment>.md`, `<experiment>.csv`, `figures/` and `runs/` (the files behind the numbers) into a folder.

    Args:
        plan: the plan.
        results: results of all its jobs, in the same order.
        folder: folder of the report; links are relative to it, so it can be moved.
        command: the command line that made it.
        about: further facts about how it was run.
        figure_resolution: voxels along the longest side of drawn meshes; None draws no figures.
        is_growing: whether runs are still going on, after which the report is written again. Files behind the numbers that it
            has already are not copied again.

    Returns:
        The written tables and figures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    copies = {id(result): _copy(result, folder, keep=is_growing) for result in results}

    def link(result: Result, stage: str) -> str | None:
        return copies[id(result)].get(stage)

    name = plan.experiment.name
    table = folder / f"{name}.csv"
    with atomic_path(table) as temporary:
        temporary.write_bytes(csv_table(plan, results, link).encode())
    figures = [] if figure_resolution is None else draw_figures(plan, results, folder / "figures", figure_resolution)
    text = folder / f"{name}.md"
    sections = [
        _head(plan, results, command, about, is_growing),
        _tables(plan, results, link),
        _figures_text(figures, folder),
        f"## Runs\n\nEvery number links to the file that it is from.\n\n{markdown_runs(plan, results, link)}",
        *provenance_sections(results),
    ]
    with atomic_path(text) as temporary:
        temporary.write_bytes(("\n\n".join(section for section in sections if section) + "\n").encode())
    return [text, table, *(path for path, _ in figures)]


def _head(plan: Plan, results: Sequence[Result], command: str, about: str, is_growing: bool) -> str:
    """Return title, state, command, origin of the numbers, settings and what the columns are."""
    experiment = plan.experiment
    settings = ", ".join(f"{key} {_plain(value)}" for key, value in plan.training_settings.items() if key != "name")
    extra = f"; all with {', '.join(plan.extra)}" if plan.extra else ""
    now = datetime.now(timezone.utc)
    lines = [
        f"# {experiment.title}",
        "",
        *_unfinished(results, is_growing),
        f"    {command}",
        "",
        f"- made {now:%Y-%m-%d %H:%M} UTC by snarf {snarfcli.__version__}{f', {about}' if about else ''}",
        *(f"- {line}" for line in provenance_lines(results)),
        f"- data {plan.data}, subjects {', '.join(plan.subjects)}, seeds {', '.join(map(str, plan.seeds))}",
        f"- training={plan.training}: {settings}{extra}; differences of single rows are in the `config.yaml` of their runs",
    ]
    lines += [f"- {note}" for note in (*experiment.notes, *(row.note for row in experiment.rows if row.note))]
    source = paper_source(experiment.name)
    if source and plan.data != "dfaust":
        lines.append(f"- the papers' numbers ({source}) are for DFaust, PosePrior and a GPU; compare the order, not the values")
    elif source:
        lines.append(f"- the papers' numbers: {source}, ten subjects, one Quadro RTX 6000")
    lines += ["", "Columns:", ""]
    lines += [f"- **{column.title}**: {column.meaning}" for column in (*COLUMNS, *more_columns(results))]
    spread = "; ± is the standard deviation over seeds of the mean over subjects" if len(plan.seeds) > 1 else ""
    lines += [
        "",
        f"Numbers are means over the seeds of each subject, then over subjects{spread}. Where a run failed, the cell "
        "says so, with the number of runs that its value is from; – means that there is nothing to measure.",
    ]
    return "\n".join(lines)


def _unfinished(results: Sequence[Result], is_growing: bool) -> list[str]:
    """Return the paragraph that says how many runs are done; none if all are."""
    done = sum(result.state == "done" for result in results)
    if done == len(results):
        return []
    what = "this page is written again after every run" if is_growing else "the section Not done says why"
    return [f"**Unfinished: {done} of {counted(len(results), 'run')} done**; {what}.", ""]


def _tables(plan: Plan, results: Sequence[Result], link: Any) -> str:
    """Return the tables, the comparison with the order of the papers, and the list of unfinished runs."""
    sections = []
    several = len(plan.subjects) > 1
    title = "## Mean over subjects" if several else f"## Subject {plan.subjects[0]}"
    sections.append(f"{title}\n\n{markdown_table(plan, results, link, subject=None if several else plan.subjects[0])}")
    order = order_lines(plan, results)
    if order:
        listed = "\n".join(f"- {line}" for line in order)
        sections.append(f"Surface IoU out of distribution, in the order reported by the papers:\n\n{listed}")
    more = more_columns(results)
    if more:
        sections.append(f"## More measures\n\n{markdown_table(plan, results, link, more)}")
    for subject in plan.subjects if several else ():
        sections.append(f"## Subject {subject}\n\n{markdown_table(plan, results, link, COLUMNS, subject)}")
    broken = [result for result in results if result.state != "done"]
    if broken:
        reasons = [f"{result.job.name}: {result.state}: {result.reason}" for result in broken if result.reason != NOT_RUN]
        told = [f"- {plain_markdown(reason)}" for reason in reasons]  # their words are from files and logs
        others = len(broken) - len(told)
        told += [f"- {counted(others, 'run')}{' more' if told else ''}: {NOT_RUN}"] if others else []
        sections.append("## Not done\n\n" + "\n".join(told))
    return "\n\n".join(sections)


def _figures_text(figures: Sequence[tuple[Path, str]], folder: Path) -> str:
    if not figures:
        return ""
    lines = ["## Figures"]
    for path, caption in figures:
        lines.append(f"![{caption}]({path.relative_to(folder).as_posix()})\n\n{caption}")
    return "\n\n".join(lines)


def _copy(result: Result, folder: Path, keep: bool) -> dict[str, str]:
    """Copy the files of a run into the report, without the numbers of single frames; return their relative paths.

    With `keep`, a copy that is newer than its file stays.
    """
    links = {}
    for stage, path in result.files.items():
        relative = Path("runs") / result.job.subject / Path(result.job.folder).name / _COPIES[stage]
        links[stage] = relative.as_posix()
        if keep and _is_newer(folder / relative, path):
            continue
        metrics = read_metrics(path)
        for sequence in metrics.sequences.values():
            sequence.pop("per_frame", None)
        write_json(folder / relative, metrics.content | ({"sequences": metrics.sequences} if metrics.sequences else {}))
    return links


def _is_newer(path: Path, than: Path) -> bool:
    return path.is_file() and path.stat().st_mtime > than.stat().st_mtime


def _plain(value: Any) -> str:
    """Return a value as it is written on the command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
