"""Run every command twice at the same time in one folder, with 0 to 5 seconds between the starts, and compare the results.

    python tools/trust_pairs.py                        # 20 pairs of each command
    python tools/trust_pairs.py --only train --pairs 50

The files must be those of one undisturbed command; one of the two may be refused, by a line that says who is at work. Every
second pair waits (wait=true) instead. The exit code is 1 if something was wrong. Linux only.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from trust.faults import Bench, restart_preloaded
from trust.scenarios import SCENARIOS

_LONGEST_S = 5.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, default=list(SCENARIOS), help="commands")
    parser.add_argument("--pairs", type=int, default=20, help="pairs of each command")
    options = parser.parse_args()
    restart_preloaded()
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="snarf-pairs-") as folder:
        bench = Bench(Path(folder))
        for name in options.only:
            scenario = SCENARIOS[name]
            bench.operations(scenario)
            start, failed = time.monotonic(), 0
            for number in range(options.pairs):
                delay_s = _LONGEST_S * number / max(1, options.pairs - 1)
                more = ("wait=true",) if number % 2 and not scenario.is_slow else ()
                problems = bench.pair_problems(scenario, delay_s, *more)
                failed += bool(problems)
                for problem in problems:
                    print(f"    {name}, {delay_s:.1f} s apart{', waiting' if more else ''}: {problem}", flush=True)
            print(f"{name}: {options.pairs} pairs, {failed} wrong, {time.monotonic() - start:.0f} s", flush=True)
            wrong += failed
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
