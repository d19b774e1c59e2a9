"""Where the numbers of a report come from: versions of the code, machines, and what the runs have cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from snarfcli.reproduce.durations import time_text
from snarfcli.reproduce.results import Metrics, Result
from snarfcli.texts import counted, one_line, plain_markdown

__all__ = ["code_versions", "cost_text", "machines", "provenance_lines", "provenance_sections"]

_LONGEST = 80

Origins = dict[str, list[str]]
"""Names of runs by what their numbers come from. A run whose stages differ is in several lists, with the stages in brackets."""


def code_versions(results: Sequence[Result]) -> Origins:
    """Return the runs of each version of the code; a version is what its files are, so two commits can be the same one."""
    commits: dict[str, list[str]] = {}
    for result in results:
        for code in (code for origin in result.origins.values() for code in _codes(origin)):
            digest, commit = _text(code.get("digest")), _text(code.get("commit"))
            if commit and commit not in commits.setdefault(digest, []):
                commits[digest].append(commit)

    def version(code: dict[str, Any]) -> str:
        digest = _text(code.get("digest"))
        names = commits.get(digest, []) if digest else [_text(code.get("commit"))]
        parts = [f"commit {' = '.join(names)}"] if any(names) else []
        return ", ".join([*parts, f"files {digest}"] if digest else parts) or "unknown version"

    return _grouped(results, lambda origin: [version(code) for code in _codes(origin)])


def machines(results: Sequence[Result]) -> Origins:
    """Return the runs of each machine, with its number of threads and its version of PyTorch."""
    return _grouped(results, lambda origin: [_machine(origin)])


def cost_text(results: Sequence[Result]) -> str:
    """Return the wall time and the processor time of all runs together; empty if no run has recorded them."""
    spent = [result.spent_s for result in results if result.spent_s is not None]
    processor = [result.processor_s for result in results if result.processor_s is not None]
    if not spent:
        return ""
    which = counted(len(spent), "run") if len(spent) == len(results) else f"{len(spent)} of {counted(len(results), 'run')}"
    text = f"{which}: {time_text(sum(spent))} one after the other"
    if processor:
        text += f" and {time_text(sum(processor))} of processor time"
    return f"{text}, with samples, validations, evaluations and the start of every command"


def provenance_lines(results: Sequence[Result]) -> list[str]:
    """Return the lines of a report's head: code, machine and cost."""
    lines = []
    for what, plural, found in (
        ("code", "versions", code_versions(results)),
        ("machine", "combinations of machine and threads", machines(results)),
    ):
        if len(found) > 1:
            lines.append(f"{what}: **{len(found)} {plural}**, listed at the end of the page")
        else:
            lines.append(f"{what}: {next(iter(found), 'no run yet')}")
    cost = cost_text(results)
    return [*lines, *([f"cost: {cost}"] if cost else [])]


def provenance_sections(results: Sequence[Result]) -> list[str]:
    """Return the sections that list the runs of each version of the code and of each machine; none where there is one only."""
    return [
        f"## {title}\n\n" + "\n".join(f"- {origin}: {'; '.join(runs)}" for origin, runs in found.items())
        for title, found in (("Versions of the code", code_versions(results)), ("Machines and threads", machines(results)))
        if len(found) > 1
    ]


def _codes(origin: Metrics) -> list[dict[str, Any]]:
    """Return the versions of the code that made a file; a training that was continued can have several."""
    return [*origin.earlier_code, origin.code]


def _grouped(results: Sequence[Result], keys: Callable[[Metrics], list[str]]) -> Origins:
    found: Origins = {}
    for result in results:
        stages: dict[str, list[str]] = {}
        for stage, origin in result.origins.items():
            for text in dict.fromkeys(keys(origin)):
                stages.setdefault(text, []).append(stage)
        for text, some in stages.items():
            part = "" if len(stages) == 1 else f" ({', '.join(some)})"
            found.setdefault(text, []).append(plain_markdown(result.job.name) + part)
    return found


def _machine(origin: Metrics) -> str:
    machine, versions = origin.machine, origin.versions
    cores, threads = (
        counted(machine[name], noun) if type(machine.get(name)) is int else ""
        for name, noun in (("cores", "core"), ("threads", "thread"))
    )
    parts = [machine.get("processor"), cores, threads and f"{threads} per run"]
    parts += [machine.get("gpu"), machine.get("system"), "torch" in versions and f"PyTorch {versions['torch']}"]
    return ", ".join(_text(str(part)) for part in parts if part) or "unknown machine"


def _text(value: object) -> str:
    """Return a text of a file for Markdown; empty if it is none."""
    return plain_markdown(one_line(value, _LONGEST)) if isinstance(value, str) else ""
