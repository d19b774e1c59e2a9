"""Run folders, devices and seeds, and the facts that every run records."""

from __future__ import annotations

import logging
import os
import platform
import random
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import torch

from snarfcli.devices import gpus_in_turn, why_no_gpu, why_unusable
from snarfcli.errors import UserError, nearest
from snarfcli.versions import recorded_code, recorded_versions

__all__ = ["check_device", "choose_device", "find_avatar", "machine_facts", "run_folder", "seed_everything", "set_threads"]

log = logging.getLogger(__name__)

_AVATAR_FILES = ("avatar.pt", "model.safetensors")


def run_folder(output_root: str, data: str, subject: str, run: str) -> Path:
    """Return the folder of one run: `<output_root>/<data>/<subject>/<run>`.

    Raises:
        UserError: a name is empty or contains a path. (overwrite=true deletes the folder, so it must belong to this run alone.)
    """
    for name, value in (("data.name", data), ("subject", str(subject)), ("run", run)):
        if value in ("", ".", "..") or any(separator in value for separator in "/\\:"):
            raise UserError(f"{name}: wanted the name of a folder, without / \\ and :, got '{value}'")
    return Path(output_root) / data / str(subject) / run


def find_avatar(output_root: str, data: str, subject: str, run: str, ckpt: str | None) -> Path:
    """Return the file of a trained avatar.

    Raises:
        UserError: it does not exist; the message names the command that trains one.
    """
    if ckpt is not None:
        path = Path(ckpt)
        if path.is_dir():  # of a run, or of Avatar.save_pretrained
            path = next((file for file in map(path.joinpath, _AVATAR_FILES) if file.is_file()), path)
        if not path.is_file():
            raise UserError(f'no avatar at {ckpt} (ckpt); give the avatar.pt that "snarf train" has written')
        return path
    folder = run_folder(output_root, data, subject, run)
    if not (folder / "avatar.pt").is_file():
        trained = sorted(p.parent.name for p in folder.parent.glob("*/avatar.pt"))
        hint = f"; trained runs there: {', '.join(trained)}{nearest(run, trained)}" if trained else ""
        other = f"give {shlex.quote(f'run={trained[0]}') if len(trained) == 1 else 'run=NAME'}, " if trained else ""
        settings = {"data": data, "subject": subject, "output_root": output_root, "run": run}
        usual = {"data": "builtin", "output_root": "outputs", "run": "fast_snarf"}
        chosen = " ".join(shlex.quote(f"{name}={value}") for name, value in settings.items() if value != usual.get(name))
        raise UserError(f'no avatar in {folder}{hint}; {other}run "snarf train {chosen}" or give ckpt=PATH')
    return folder / "avatar.pt"


def check_device(name: str) -> None:
    """Check that a device is named "auto", "cpu", "cuda" or "cuda:N", and that PyTorch sees it. Does not start CUDA.

    Raises:
        UserError: it is not; the message states the reason.
    """
    if name == "auto":
        return
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise UserError(f"device: wanted auto, cpu, cuda or cuda:N, got {name!r}")
    if device.type == "cuda":
        reason, count = why_no_gpu(), torch.cuda.device_count()
        if reason is None and (device.index or 0) >= count:
            reason = f"PyTorch sees {count} GPU{'' if count == 1 else 's, the last one cuda:' + str(count - 1)}"
        if reason is not None:
            raise UserError(f"device: wanted {name}, got none, since {reason}; give device=cpu")


def choose_device(name: str) -> torch.device:
    """Return the device named "auto" (a GPU if one can be used), "cpu", "cuda" or "cuda:N", and make a GPU the current one.

    Of several GPUs, "auto" and "cuda" take that of this process's slot (`snarfcli.slots`) or, if it cannot be used, the next.

    Raises:
        UserError: the name is unknown, or the GPU cannot be used; the message states the reason.
    """
    check_device(name)
    device = torch.device("cuda" if name == "auto" else name)
    if device.type == "cpu":
        return device
    reasons = [] if (reason := why_no_gpu()) is None else [reason]
    for gpu in gpus_in_turn() if device.index is None else [device]:
        reason = why_unusable(gpu)
        if reason is None:
            torch.cuda.set_device(gpu)  # for what takes no device, such as the capture of a CUDA graph
            return gpu
        reasons.append(reason)
    if name != "auto":
        raise UserError(f"device: wanted {name}, got none, since {reasons[0]}; give device=cpu")
    if torch.version.cuda:
        log.info("device=auto: the CPU is used, since %s", reasons[0])
    return torch.device("cpu")


def set_threads(threads: int | None) -> None:
    """Set the number of threads for tensor work; None keeps PyTorch's choice, which follows OMP_NUM_THREADS."""
    if threads is not None:
        if threads < 1:
            raise UserError(f"threads: wanted at least 1, got {threads}")
        torch.set_num_threads(threads)


def seed_everything(seed: int) -> None:
    """Seed the random number generators of Python, NumPy and PyTorch."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def machine_facts(device: torch.device | None = None) -> dict[str, Any]:
    """Return the versions, the code and the machine of a result, as `versions`, `code` and `machine`.

    Args:
        device: device that computed the result, if a GPU can have done so.
    """
    machine = {"system": platform.system(), "processor": _processor(), "cores": os.cpu_count()}
    machine["threads"] = torch.get_num_threads()
    if device is not None and device.type == "cuda":
        machine["gpu"] = torch.cuda.get_device_name(device)
    return {"versions": recorded_versions(), "code": recorded_code(), "machine": machine}


def _processor() -> str:
    """Return the processor's name."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
