"""Collect into one folder what gpu_check.py needs beside a checkout, for a machine with little more than PyTorch and NumPy.

    python benchmarks/pack_gpu_check.py                   outputs/gpu_check: samples, avatars, scenes, library, the CPU's IoU
    python benchmarks/pack_gpu_check.py --python 3.12     the same with packages for Python 3.12 on 64-bit Linux

Takes some minutes on two cores: subject 50002 is sampled with half the frames and half the points; `quick` is trained with
these samples on the CPU, whose IoU the GPU is compared with, and an avatar with the papers' networks for fewer steps. What is
there already is kept.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for a checkout that is not installed

from gpu_checks.packed_samples import copy_samples
from gpu_checks.scene_cases import POSES

from snarfcli.errors import UserError
from snarfcli.files import read_json, write_json, write_tensors
from snarfcli.native.library import library_path
from snarfcli.safe_start import safe_environment, snarf_command
from snarfcli.texts import terminal_text

ROOT = Path(__file__).resolve().parents[1]
SUBJECT = "50002"
SAMPLES = ("data.frame_step=8", "data.test_frame_step=8", "points_per_frame=10000")
# The papers' networks, from capsules and with the steps of `quick`: a usable shape after few steps.
PAPER = ("training=quick", "skinning=distilled", "shape=mlp", "condition=global", "shape.prior_radius_m=0.07",
         "shape.geometric_init=false", "shape.condition_at_start=false")  # fmt: skip
LIMIT_MB = 60
PACKAGES = ("antlr4-python3-runtime", "filelock", "hydra-core", "libigl", "omegaconf", "packaging", "PyYAML", "tqdm")
EXPECTED = "scipy, scikit-image, pillow, tensorboard and pytest"
PLATFORMS = [f"manylinux_2_{minor}_x86_64" for minor in (17, 24, 27, 28, 31, 34, 35)] + ["manylinux2014_x86_64"]


def main() -> int:
    options = parse()
    try:
        pack(options)
    except (UserError, subprocess.CalledProcessError) as error:
        print(f"pack_gpu_check: {terminal_text(str(error))}", file=sys.stderr)
        return 2
    return 0


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "gpu_check", help="the folder")
    parser.add_argument("--build", type=Path, default=ROOT / "outputs" / "gpu_check_build", help="folder for samples and runs")
    parser.add_argument("--paper-steps", type=int, default=600, help="steps of the avatar with the papers' networks")
    parser.add_argument("--paper-run", type=Path, help="a finished CPU run of training=paper on these samples, for its IoU")
    parser.add_argument("--python", help="Python of the other machine, as 3.12; its packages are packed too")
    parser.add_argument("--packages", default=",".join(PACKAGES), help="those the other machine lacks (default: %(default)s)")
    return parser.parse_args(arguments)


def pack(options: argparse.Namespace) -> None:
    """Make what is missing in the folder and print what it holds.

    Raises:
        UserError: --python is no version, a package is not installed here, or the folder is larger than the limit.
        CalledProcessError: a command failed; its output says why.
    """
    if options.python and not re.fullmatch(r"3\.\d{1,2}", options.python):
        raise UserError(f"--python: wanted a version such as 3.12, got {options.python}")
    out, build = options.out.resolve(), options.build.resolve()
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "data" / "processed" / "builtin" / SUBJECT / "manifest.json").exists():
        snarf("preprocess", f"data_root={build / 'data'}", *SAMPLES)
        copy_samples(build / "data", out / "data", SUBJECT)
    pack_avatar(build, out, "quick", "training=quick")
    pack_avatar(build, out, "paper", *PAPER, f"training.steps={options.paper_steps}")
    pack_cpu(build, out, options.paper_run)
    if not (out / "scenes.pt").exists():
        write_tensors(out / "scenes.pt", scenes())
    library = library_path()
    if library is not None:
        shutil.copy2(library, out / library.name)
    if options.python:
        pack_wheels(out / "wheels", options.python, options.packages.split(","))
    report(out, None if library is None else library.name)


def pack_avatar(build: Path, out: Path, name: str, *overrides: str) -> None:
    """Train an avatar on the CPU."""
    target = out / "avatars" / f"{name}.pt"
    if not target.exists():
        snarf("train", *_run_places(build, out, name), "device=cpu", "resume=true", *overrides)
        target.parent.mkdir(exist_ok=True)
        shutil.copy2(build / "runs" / "builtin" / SUBJECT / name / "avatar.pt", target)


def pack_cpu(build: Path, out: Path, paper_run: Path | None) -> None:
    """Write the IoU of the CPU's runs, in percent."""
    found = read_json(out / "cpu.json", "numbers of the CPU") if (out / "cpu.json").exists() else {}
    if "quick" not in found:
        found["quick"] = cpu_iou(build, out, "run=quick", build / "runs" / "builtin" / SUBJECT / "quick")
    if paper_run is not None:
        found["paper"] = cpu_iou(build, out, f"ckpt={paper_run.resolve()}", paper_run.resolve())
    write_json(out / "cpu.json", found)


def cpu_iou(build: Path, out: Path, which: str, folder: Path) -> dict[str, dict[str, float]]:
    """Evaluate an avatar on both splits; return the IoU, bbox and surface, by split."""
    found = {}
    for split in ("id", "ood"):
        snarf("eval", *_run_places(build, out, "quick")[:-1], which, f"split={split}", "figure=false", "device=cpu")
        metrics = read_json(folder / f"eval_{split}" / "metrics.json", "metrics")
        found[split] = {kind: 100 * metrics[kind] for kind in ("iou_bbox", "iou_surface")}
    return found


def _run_places(build: Path, out: Path, name: str) -> list[str]:
    return [f"data_root={out / 'data'}", f"output_root={build / 'runs'}", f"run={name}"]


def scenes() -> dict[str, object]:
    """Return the scenes that `scene_cases.Scenes` reads: the body's weights, and its surface in some poses."""
    from scenes import NINE_BONES, _pose, body_scene

    from snarfcli.sampling import sampling_cube

    saved: dict[str, object] = {}
    poses = {}
    for name in POSES:
        scene = body_scene(name)
        surface = scene.posed(scene.surface)
        lower, side = sampling_cube(surface)
        surface = surface[:20_000]
        poses[name] = {
            "pose": _pose(name),
            "bones": scene.transforms,
            "surface": torch.as_tensor(surface, dtype=torch.float32),
            "cube": torch.tensor([*lower, side], dtype=torch.float32),
        }
        box = torch.stack([scene.grid.lower, scene.grid.upper])
        saved = {"weights": scene.weights.half(), "box": box, "near": scene.near_cells, "nine": list(NINE_BONES)}
    return saved | {"poses": poses}


def pack_wheels(folder: Path, python: str, packages: Sequence[str]) -> None:
    """Get wheels of the packages, in the versions that are installed here, for another Python on 64-bit Linux."""
    wanted = []
    for package in packages:
        try:
            wanted.append(f"{package}=={version(package)}")
        except PackageNotFoundError:
            raise UserError(f"package {package} is not installed here, so its version is not known; leave it out") from None
    folder.mkdir(exist_ok=True)
    there = {path.name.split("-")[0].lower().replace("_", "-") for path in folder.glob("*.whl")}
    platforms = [argument for name in PLATFORMS for argument in ("--platform", name)]
    for package in wanted:
        if package.split("==")[0].lower() in there:
            continue
        pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
        binary = [*pip, "download", "--no-deps", "--only-binary=:all:", "--python-version", python, *platforms]
        if subprocess.run([*binary, "-d", str(folder), package], capture_output=True).returncode:
            # only sources: pure Python, or else the wheel's name says that it is for this machine
            subprocess.run([*pip, "wheel", "--no-deps", "-w", str(folder), package], check=True)


def report(out: Path, library: str | None) -> None:
    """Print what the folder holds, and how to use it.

    Raises:
        UserError: it is larger than the limit.
    """
    total = 0
    for path in sorted(out.iterdir()):
        size = sum(part.stat().st_size for part in ([path] if path.is_file() else path.rglob("*")) if part.is_file())
        total += size
        print(f"{size / 1e6:8.1f} MB  {path.name}")
    print(f"{total / 1e6:8.1f} MB  {out}")
    lines = ["python3 benchmarks/gpu_check.py" + ("" if out == ROOT / "outputs" / "gpu_check" else f" --pack {out.name}")]
    if library is not None:
        lines.insert(0, f"export SNARF_NATIVE_LIBRARY={_shown(out / library)}")
    if (out / "wheels").exists():
        lines.insert(0, "export PYTHONPATH=/tmp/site")
        lines.insert(0, f"python3 -m pip install -q --no-index --no-deps --target /tmp/site {_shown(out / 'wheels')}/*.whl")
    print(f"On the other machine, which also needs {EXPECTED}, in the checkout:", *lines, sep="\n    ")
    if total > LIMIT_MB * 1e6:
        raise UserError(f"{out} has {total / 1e6:.0f} MB, more than {LIMIT_MB}; name fewer packages with --packages")


def _shown(path: Path) -> str:
    """Return a path below the checkout relative to it, as the other machine has it, and any other below $PWD."""
    return f"$PWD/{path.relative_to(ROOT) if path.is_relative_to(ROOT) else Path(path.parent.name) / path.name}"


def snarf(command: str, *overrides: str) -> None:
    """Run a command of snarf for the subject."""
    print(f"snarf {command} {' '.join(overrides)}", flush=True)
    subprocess.run(snarf_command([command, f"subject={SUBJECT}", *overrides]), env=safe_environment(), check=True)


if __name__ == "__main__":
    sys.exit(main())
