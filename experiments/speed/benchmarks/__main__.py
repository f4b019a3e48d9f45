"""How fast, how exact and how large is tvsbayes beside its peers?

One command measures everything in turn and writes the README.md beside it. Every part runs in a process of its own; its
rows go to `experiments/output/speed/`, and what is there is not measured again: an interrupted run goes on. Rows belong
to one machine, one set of versions and one state of the package.

For timings worth quoting: a quiet machine, and one core for everything but the part `study`, which takes two:

    taskset -c 0 python -m experiments.speed.benchmarks
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent


PARTS = {
    "lm": "least squares of the fit against scipy.optimize.least_squares",
    "strd": "NIST's StRD problems: digits and time against scipy",
    "posterior": "effective draws per CPU second against two NUTS and the stretch move",
    "spots": "spot centres against photutils, and against only decoding the pictures",
    "stereo": "stereo calibration against cv2.stereoCalibrate",
    "study": "campaigns per minute, serial against processes",
    "start": "commands in fresh processes, cold and warm, against bare imports",
    "memory": "peak memory per command",
    "scaling": "time and memory of the fit against the number of spots",
}
NEEDS = {"strd": ("pytest",), "posterior": ("blackjax", "numpyro"), "spots": ("photutils",)}
INSTALL = "pip install -c .ci/constraints.txt -e '.[bench,test]'"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    listed = "\n".join(f"  {name:10s} {about}" for name, about in PARTS.items())
    cli = argparse.ArgumentParser(
        prog="python -m experiments.speed.benchmarks",
        description=f"{__doc__}\nparts:\n{listed}\n\nThe peers come with the extra bench: {INSTALL}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    cli.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help="default: all")
    cli.add_argument("--repeats", type=int, default=5, help="turns of each contender (5); costly cases take fewer")
    sizes = "spots in the part scaling (100 1000 10000; 100000 takes ten minutes or more by itself)"
    cli.add_argument("--sizes", type=int, nargs="+", default=[100, 1_000, 10_000], help=sizes)
    cli.add_argument("--limit", type=float, default=480.0, help="seconds after which a size counts as too long (480)")
    cli.add_argument("--table", action="store_true", help="measure nothing, write the table from the rows there are")
    cli.add_argument("--fresh", action="store_true", help="set the rows aside and measure anew")
    cli.add_argument("--worker", choices=PARTS, help=argparse.SUPPRESS)
    cli.add_argument("--spots", type=int, help=argparse.SUPPRESS)
    return cli


def absent(parts: list[str]) -> dict[str, list[str]]:
    """Packages that chosen parts need and this environment lacks."""
    lacking = {name: [n for n in NEEDS.get(name, ()) if importlib.util.find_spec(n) is None] for name in parts}
    return {name: packages for name, packages in lacking.items() if packages}


def measured(part: str, arguments: argparse.Namespace) -> None:
    """One part in this process."""
    from experiments.common.rows import read_rows
    from experiments.speed.benchmarks.measure import Bench, rows_path

    path = rows_path()
    rows = [row for row in read_rows(path) if row["part"] == part]
    module = importlib.import_module(f".{part}", __package__)
    options = {"sizes": arguments.sizes, "limit_s": arguments.limit} if part == "scaling" else {}
    module.measure(Bench(part, arguments.repeats, path, rows), **options)


def environment(part: str) -> dict[str, str]:
    """Compared code runs on one thread; commands and sizes run as users start them."""
    from tvsbayes.studies.executors import SINGLE_THREADED

    alone = {} if part in ("study", "start", "memory", "scaling") else SINGLE_THREADED
    return {**os.environ, **alone}


def main() -> int:
    """Measure the parts one after the other, then write the table."""
    arguments = parser().parse_args()
    if arguments.spots is not None:
        from experiments.speed.benchmarks.scaling import one_size

        print(json.dumps(one_size(arguments.spots)))
        return 0
    if arguments.worker:
        measured(arguments.worker, arguments)
        return 0
    failed = []
    if not arguments.table:
        lacking = absent(arguments.parts)
        if lacking:
            for name, packages in lacking.items():
                print(f"the part {name} needs {' and '.join(packages)}, which this environment lacks", file=sys.stderr)
            print(f"install it with: {INSTALL}\nor choose --parts without it", file=sys.stderr)
            return 2
        from experiments.speed.benchmarks.measure import rows_path

        path = rows_path()
        if arguments.fresh and path.exists():
            path.rename(path.with_suffix(f".{int(time.time())}.jsonl"))
        for part in arguments.parts:
            begun = time.perf_counter()
            command = [sys.executable, "-m", "experiments.speed.benchmarks", "--worker", part]
            command += ["--repeats", str(arguments.repeats), "--limit", str(arguments.limit)]
            command += ["--sizes", *map(str, arguments.sizes)]
            done = subprocess.run(command, env=environment(part), cwd=HERE.parents[2])
            print(f"{part}: {time.perf_counter() - begun:.0f} s", flush=True)
            if done.returncode:
                failed.append(part)
    from experiments.speed.benchmarks.measure import write

    write(HERE / "README.md", list(PARTS))
    if failed:
        print(f"failed: {', '.join(failed)}; their tables lack rows", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
