"""`snarf doctor`: what is installed, what runs natively, and where a fallback runs instead and why.

Imports of PyTorch and of rooms that need it stand inside functions: the report must also work when they are broken.
"""

from __future__ import annotations

import logging
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

from omegaconf import MISSING

import snarfcli
from snarfcli.commands.doctor_findings import Finding, promises
from snarfcli.commands.doctor_tools import TOOLS, describe_error, extras, package_finding, tools
from snarfcli.datasets.settings import DataConfig, command_settings
from snarfcli.errors import UserError
from snarfcli.extras import why_not_imported
from snarfcli.parallel import count_cores
from snarfcli.texts import counted
from snarfcli.versions import RECORDED_PACKAGES

__all__ = ["DoctorConfig", "Finding", "run"]

log = logging.getLogger(__name__)

_SUBJECTS_CHECKED = 3  # of a data set; each takes some seconds
_LISTED = 8  # names of data or runs on one line
_OF_MOTIONS = {"up": "auto", "hands": "rest", "rest": "auto", "mapping": None, "clip": None}
"""Settings that need a motion file, and their defaults."""
_OTHER_PACKAGES = ("scipy", "hydra-core", "tensorboard")


@dataclass
class DoctorConfig:
    """Settings of `snarf doctor`."""

    data_root: str = MISSING
    """Folder with the data and the processed samples."""
    output_root: str = MISSING
    """Folder with the trained avatars."""
    data: DataConfig | None = None
    """Data set to check, instead of the installation."""
    subject: str | None = None
    """Subject of the data set to check; all for every subject, null for the first three. With `pose`: whose body is used."""
    body: str | None = None
    """Body model file, or a folder with it; null searches below data_root."""
    figure: str | None = None
    """File for the picture; null for <data>_<subject>.png, or that of the motion file, in <output_root>/doctor."""
    pose: str | None = None
    """Motion file to check: how it is read, and what it looks like on a body (the built-in one, or that of a data set)."""
    up: str = "auto"
    """Up axis of the motion file: auto, y, z, x, -y, -z or -x."""
    hands: str = "rest"
    """SMPL's hand joints if the motion file has fingers instead: rest or released."""
    rest: str = "auto"
    """For rigs: rest pose to compare with the body's: auto, file, clip (all frames), or the number of a frame."""
    mapping: str | None = None
    """For rigs: JSON file {joint of the body: joint of the file}; null matches common joint names."""
    clip: str | None = None
    """Name or number of the animation or person in the motion file; null for the first."""


def run(config: DoctorConfig) -> int:
    """Print the report. A part that cannot be examined is reported with its error, and the other parts follow.

    Returns:
        0, also if fallbacks are in use; 2 if the data set to check cannot be used.

    Raises:
        UserError: a setting for motion files is given without one.
    """
    if config.pose is not None:
        return _check_pose(config, config.pose)
    for name, usual in _OF_MOTIONS.items():
        if getattr(config, name) != usual:
            raise UserError(f"{name}: wanted a motion file to use it with, got none; add --pose FILE")
    if config.data is not None:
        return _check_data(config, config.data)
    sections: dict[str, Callable[[], Iterator[Finding]]] = {
        "versions": _versions,
        "processor": _processor,
        "GPU": _gpu,
        "tools": tools,
        "extras, each optional": extras,
        "data": lambda: _data(Path(config.data_root), Path(config.output_root)),
        "what is promised (docs/promises.md)": lambda: promises(Path(config.data_root), Path(config.output_root)),
    }
    fallbacks: list[str] = []
    for title, examine in sections.items():
        log.info("%s", title)
        for finding in _findings(examine):
            log.info("  %-16s%s", finding.name, finding.text)
            if finding.is_fallback:
                fallbacks.append(finding.name)
    log.info("")
    log.info("%s", f"fallbacks or missing parts: {', '.join(fallbacks)} (see above)" if fallbacks else "nothing is missing")
    return 0


def _check_pose(config: DoctorConfig, pose: str) -> int:
    """Report how a motion file is read, and draw it; return 0.

    Raises:
        UserError: it cannot be used.
    """
    from snarfcli.checks import check_choice
    from snarfcli.commands.doctor_pose import PoseQuestion, check_pose
    from snarfcli.datasets.sources import Request
    from snarfcli.motions.layouts import HANDS
    from snarfcli.motions.reader import motion_name
    from snarfcli.motions.up_axis import UPS

    check_choice("up", config.up, UPS)
    check_choice("hands", config.hands, HANDS)
    data = DataConfig(name="builtin") if config.data is None and config.subject is not None else config.data
    request = None if data is None else Request(data, Path(config.data_root), config.body)
    question = PoseQuestion(pose, config.up, config.hands, config.rest, config.mapping, config.clip, request, config.subject)
    figure = Path(config.output_root) / "doctor" / f"{motion_name(Path(pose))}.png"
    check_pose(question, Path(config.figure or figure))
    return 0


def _check_data(config: DoctorConfig, data: DataConfig) -> int:
    """Report whether a data set can be used and what to correct; draw each examined subject."""
    from snarfcli.datasets.checking import ExaminedFrame, Remark, check_subject
    from snarfcli.datasets.registry import find_dataset
    from snarfcli.datasets.sources import Request
    from snarfcli.datasets.subjects import SubjectData
    from snarfcli.rendering.bones import write_bones_figure
    from snarfcli.scanned_subjects.fit_report import fit_remarks

    request = Request(data, Path(config.data_root), config.body)
    subjects = [config.subject] if config.subject not in (None, "all") else list(find_dataset(data.name).subjects(request))
    chosen = subjects if config.subject is not None else subjects[:_SUBJECTS_CHECKED]
    log.info("data set %s, subjects: %s", data.name, _listed(subjects))
    unusable: list[str] = []
    for subject in chosen:
        figure = Path(config.output_root) / "doctor" / f"{data.name}_{subject}.png"
        if config.figure is not None:
            figure = Path(config.figure)
            figure = figure if len(chosen) == 1 else figure.with_stem(f"{figure.stem}_{subject}")

        def draw(data: SubjectData, frames: list[ExaminedFrame], figure: Path = figure) -> Remark:
            write_bones_figure(figure, f"{data.data} data, subject {data.subject}", data.skeleton, frames)
            return Remark("figure", str(figure))

        log.info("subject %s", subject)
        for remark in chain(check_subject(subject, request, draw), fit_remarks(subject, request)):
            mark = {"fact": "", "warning": "warning: ", "problem": "PROBLEM: "}[remark.kind]
            log.info("  %-16s%s%s", remark.name, mark, remark.text)
            if remark.kind == "problem" and subject not in unusable:
                unusable.append(subject)
    log.info("")
    if len(chosen) < len(subjects):
        log.info("%d more subjects were not checked; give subject=NAME or subject=all", len(subjects) - len(chosen))
    if unusable:
        log.info("not usable as it is: %s (see PROBLEM above)", _listed(unusable))
    else:
        log.info('usable; next: "snarf preprocess %s"', command_settings(data, chosen[0], config.data_root))
    return 2 if unusable else 0


def _findings(examine: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """Yield the findings of a section, the last one being the error that ended it, if any."""
    try:
        yield from examine()
    except Exception as error:  # anything can fail in a broken installation, which this command exists to explain
        yield Finding("error", describe_error(error), is_fallback=True)


def _versions() -> Iterator[Finding]:
    yield Finding("snarf", f"{snarfcli.__version__}, {Path(snarfcli.__file__).parent}")
    yield Finding("python", f"{platform.python_version()}, {sys.executable}")
    yield Finding("platform", f"{platform.platform()}, {platform.machine()}")
    yield package_finding("torch", "torch", partial(why_not_imported, "torch", "torch"))
    for package in (*RECORDED_PACKAGES, *_OTHER_PACKAGES):
        if package not in ("snarf", "torch", *TOOLS):
            yield package_finding(package, package)


def _processor() -> Iterator[Finding]:
    from snarfcli.runs import machine_facts

    machine = machine_facts()["machine"]
    yield Finding("model", f"{machine['processor']}, {counted(machine['cores'], 'core')}, {count_cores()} of them usable here")
    limit = os.environ.get("OMP_NUM_THREADS")
    yield Finding("threads", f"{machine['threads']} (PyTorch's number{f'; OMP_NUM_THREADS={limit}' if limit else ''})")
    yield _native()


def _native() -> Finding:
    """Return whether the native library is active, or the reason why not."""
    from snarfcli.native.library import build_note, instruction_set, library_path, why_unavailable

    reason = why_unavailable()
    if reason is not None:
        return Finding("native library", f"not available, the reference in PyTorch is used: {reason}", is_fallback=True)
    note = build_note() if "SNARF_NATIVE_LIBRARY" not in os.environ else {}
    built = f", built by {note['compiler']} for {', '.join(note['instruction_sets'])}" if note.get("built") else ""
    return Finding("native library", f"active, {instruction_set()}, {library_path()}{built}")


def _gpu() -> Iterator[Finding]:
    import torch

    from snarfcli.devices import driver_version, why_no_gpu
    from snarfcli.native.cuda import cuda_status

    reason, count = why_no_gpu(), torch.cuda.device_count()
    driver = driver_version()
    yield Finding("PyTorch", f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA")
    yield Finding("driver", f"for CUDA {driver[0]}.{driver[1]} and older" if driver else "none")
    none = f"none, since {reason}; everything runs on the CPU"
    # A CPU build of PyTorch is a choice, and a machine without a driver most likely has no GPU.
    yield Finding("devices", none if reason else f"{count}", is_fallback=bool(reason and driver and torch.version.cuda))
    for index in range(count):
        device = torch.cuda.get_device_properties(index)
        memory = f"{device.total_memory / 2**30:.1f} GiB"
        yield Finding(f"cuda:{index}", f"{device.name}, {memory}, compute capability {device.major}.{device.minor}")
    status = cuda_status()
    yield Finding("CUDA kernels", status, is_fallback=count > 0 and "reference" in status)


def _data(data_root: Path, output_root: Path) -> Iterator[Finding]:
    if data_root.is_dir():
        folders = sorted(path.name for path in data_root.iterdir() if path.is_dir() and path.name != "processed")
        yield Finding("data_root", f"{data_root.absolute()}, folders: {_listed(folders)}")
    else:
        yield Finding("data_root", f"no folder {data_root.absolute()}; data=builtin needs none")
    samples = _names(data_root / "processed", "*/*/manifest.json")
    yield Finding("samples", _listed(samples, 'run "snarf preprocess"'))
    avatars = _names(output_root, "*/*/*/avatar.pt")
    yield Finding("avatars", _listed(avatars, 'run "snarf train"'))


def _names(root: Path, pattern: str) -> list[str]:
    """Return the folders below `root` that contain files matching a pattern."""
    return sorted(path.parent.relative_to(root).as_posix() for path in root.glob(pattern))


def _listed(names: Sequence[str], advice: str = "") -> str:
    """Return names as one line."""
    if not names:
        return f"none; {advice}" if advice else "none"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
