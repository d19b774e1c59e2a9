"""Kill commands at their file operations, and let their disk fail there; then run the same command again and compare.

    python tools/trust_faults.py                       # all commands: kill at 240 operations, errors at 120
    python tools/trust_faults.py --only train --kind kill --points 500

The second run must make the same files as an undisturbed one, and leave nothing else. A disk that fails must give one line and
exit code 2. The exit code is 1 if something was wrong. Linux only.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from trust.faults import FAULTS, Bench, restart_preloaded
from trust.scenarios import SCENARIOS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, default=list(SCENARIOS), help="commands")
    parser.add_argument("--kind", nargs="+", choices=FAULTS, default=list(FAULTS), help="faults")
    parser.add_argument("--points", type=int, default=40, help="operations per command and kind, evenly spaced")
    options = parser.parse_args()
    restart_preloaded()
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="snarf-faults-") as folder:
        bench = Bench(Path(folder))
        for name in options.only:
            scenario = SCENARIOS[name]
            count = bench.operations(scenario)
            again = bench.operations(scenario)
            print(f"{name}: {count} operations ({again} when repeated)", flush=True)
            for kind in options.kind:
                points = _chosen(count, options.points if kind == "kill" else options.points // 2, scenario.is_slow)
                start, failed = time.monotonic(), 0
                for at in points:
                    problems = bench.problems(scenario, kind, at)
                    failed += bool(problems)
                    for problem in problems:
                        print(f"    {name}, {kind} at operation {at}: {problem}", flush=True)
                print(f"  {kind}: {len(points)} operations, {failed} wrong, {time.monotonic() - start:.0f} s", flush=True)
                wrong += failed
    return 1 if wrong else 0


def _chosen(count: int, points: int, is_slow: bool) -> list[int]:
    """Return evenly spaced numbers of operations from 1 to `count`."""
    points = min(count, max(1, points // 2) if is_slow else points)
    return sorted({1 + round(index * (count - 1) / max(1, points - 1)) for index in range(points)})


if __name__ == "__main__":
    sys.exit(main())
