"""What a command has written: the content of its files, without what differs from run to run, such as times."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import torch

__all__ = ["content_of", "differences"]

_VARYING = re.compile(r"timings|machine|versions|seconds|wall.*|.*_s|.*_ms.*|frames_a_second|was_there|points|is_capped|wait")
# Logs and events grow with every call; tables have times in them; a log of jobs that have ended may stay when one has failed.
_ONLY_NAMED = re.compile(r"(.*/)?(tensorboard/.*|.*\.log|reproduce/.*\.(csv|md|png|json))")
_IGNORED = re.compile(r"(.*/)?(tensorboard/.*|reproduce\.log)")


def content_of(folder: Path) -> dict[str, str]:
    """Return a digest of each file below a folder, by its relative path; empty folders count as files."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if _IGNORED.fullmatch(name):
            continue
        if path.is_dir():
            if not any(path.iterdir()):
                found[name] = "empty folder"
        else:
            found[name] = "there" if _ONLY_NAMED.fullmatch(name) else _digest(path)
    return found


def differences(ours: dict[str, str], theirs: dict[str, str]) -> list[str]:
    """Return one line for each file that only one of two folders has, or that differs."""
    lines = [f"missing: {name}" for name in theirs if name not in ours]
    lines += [f"left behind: {name}" for name in ours if name not in theirs]
    return lines + [f"differs: {name}" for name in ours if name in theirs and ours[name] != theirs[name]]


def _digest(path: Path) -> str:
    if path.suffix == ".json":
        try:
            content = _without_varying(json.loads(path.read_text()))
        except ValueError:
            return "half"
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    if path.suffix == ".pt":
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
        except RuntimeError:
            return "half"
        digest = hashlib.sha256()
        _add(digest, _without_varying(content))
        return digest.hexdigest()
    content = path.read_bytes()
    if path.name == "config.yaml":
        content = content.replace(b"wait: true", b"wait: false")
    return hashlib.sha256(content).hexdigest()


def _without_varying(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _without_varying(value) for key, value in content.items() if not _VARYING.fullmatch(str(key))}
    return [_without_varying(value) for value in content] if isinstance(content, list) else content


def _add(digest: Any, value: Any) -> None:
    """Add a tree of dicts, lists, tensors and plain values to a digest."""
    if isinstance(value, dict):
        for key in sorted(value, key=str):
            digest.update(repr(key).encode())
            _add(digest, value[key])
    elif isinstance(value, (list, tuple)):
        for one in value:
            _add(digest, one)
    elif isinstance(value, torch.Tensor):
        digest.update(
            f"{value.dtype}{list(value.shape)}".encode() + value.contiguous().flatten().view(torch.uint8).numpy().tobytes()
        )
    else:
        digest.update(repr(value).encode())
