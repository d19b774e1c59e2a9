"""Read damaged files with every file reader and report the failures: the long form of `tests/test_fuzz.py`.

    python tools/fuzz_readers.py
    python tools/fuzz_readers.py --count 1000 --only bvh gltf
    python tools/fuzz_readers.py --count 5000 --seed 2 --only own     # the package's own formats
    python tools/fuzz_readers.py --count 5000 --only own     # readers of the package's own formats

Each reader runs in its own process with limited memory, so that a crash or a decompression bomb ends only that process; the
file that caused it is kept. The exit code is 1 if a file was mishandled.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from fuzz_own_targets import OWN_TARGETS
from fuzz_targets import TARGETS
from fuzzing import find_failures, scratch_folder

_COUNT = 20_000
_MAX_FAILURES = 20
# Address space beyond that of the imported modules: far more than the 1 GiB a file may cost, since not all of it is used.
_SPARE_ADDRESSES = 3 * 2**30


def main() -> int:
    names = [make.__name__ for make in TARGETS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, help="damaged files per reader; by default 20,000, and 5,000 for slow ones")
    parser.add_argument("--seed", type=int, default=1, help="seed of the damage")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", choices=["own", *names],
        help=f"readers; own for those of the package's own formats: {', '.join(names)}",
    )  # fmt: skip
    parser.add_argument("--folder", type=Path, default=Path("outputs/fuzz"), help="folder for the failing files")
    parser.add_argument("--child", nargs=2, metavar=("START", "SCRATCH"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        return _read_files(options.only[0], int(options.child[0]), Path(options.child[1]), options)
    total, wanted = 0, options.count
    for name in _chosen(options.only or names):
        start = time.monotonic()
        options.count = wanted or _COUNT // next(make for make in TARGETS if make.__name__ == name)().cost
        failures = _supervise(name, options)
        total += len(failures)
        seconds = time.monotonic() - start
        print(f"{name:16} {options.count} files, {len(failures)} failures, {seconds:.0f} s", flush=True)
        for failure in failures:
            print("    " + failure.replace("\n", "\n    "), flush=True)
    return 1 if total else 0


def _chosen(names: list[str]) -> list[str]:
    """Return the names of readers, with those of the package's own formats in place of "own"."""
    own = [make.__name__ for make in OWN_TARGETS]
    return list(dict.fromkeys(one for name in names for one in (own if name == "own" else [name])))


def _supervise(name: str, options: argparse.Namespace) -> list[str]:
    """Run the child process of a reader until all files are read; start it again after each crash."""
    failures: list[str] = []
    start = 0
    with scratch_folder() as scratch:
        while start < options.count and len(failures) < _MAX_FAILURES:
            shutil.rmtree(scratch)
            scratch.mkdir()
            child = subprocess.run(
                [sys.executable, __file__, "--count", str(options.count), "--seed", str(options.seed), "--only", name,
                 "--folder", str(options.folder), "--child", str(start), str(scratch)],
                capture_output=True, text=True, errors="replace",
            )  # fmt: skip
            failures += [part for part in child.stdout.split("\0") if part.strip()]
            if child.returncode == 0:
                break
            end = "\n".join(child.stderr.strip().splitlines()[-25:])
            index = int((scratch / "index").read_text()) if (scratch / "index").exists() else -1
            if index < 0:
                failures.append(f"{name}: could not start (exit code {child.returncode})\n{end}")
                break
            options.folder.mkdir(parents=True, exist_ok=True)
            (file,) = (path for path in scratch.glob("fuzz*") if path.is_file())
            kept = options.folder / f"{name}-{options.seed}-{index}{file.suffix}"
            shutil.copyfile(file, kept)
            failures.append(f"{name}: file {index} ended the process (exit code {child.returncode}), kept as {kept}\n{end}")
            start = index + 1
    return failures


def _read_files(name: str, start: int, scratch: Path, options: argparse.Namespace) -> int:
    """Read files in the child process; print each failure, ended by a zero byte."""
    import faulthandler

    faulthandler.enable()  # prints the stack after a crash
    target = next(make for make in TARGETS if make.__name__ == name)()
    for _ in find_failures(target, [], options.seed, options.folder, scratch):  # imports everything and reads the seed files
        pass
    _limit_memory()
    failures = find_failures(target, range(start, options.count), options.seed, options.folder, scratch)
    for failure in itertools.islice(failures, _MAX_FAILURES):
        print(failure, end="\0", flush=True)
    return 0


def _limit_memory() -> None:
    """Limit the memory of this process, on Linux."""
    status = Path("/proc/self/status")
    if not status.exists():
        return
    import resource

    line = next(line for line in status.read_text().splitlines() if line.startswith("VmSize"))
    limit = int(line.split()[1]) * 1024 + _SPARE_ADDRESSES
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    sys.exit(main())
