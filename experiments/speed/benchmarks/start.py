"""Commands from process start, with an empty and with a filled compilation cache, beside bare imports."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from experiments.speed.benchmarks.measure import Bench, Case, Column, command_cost

TITLE = "From process start"
FLOOR, COMMANDS = "Floor: Python and its packages", "Commands"
COLD_REPEATS = 3
IMPORTS = (
    "pass",
    "import numpy",
    "import scipy.optimize",
    "import cv2",
    "import jax",
    "import numpyro",
    "import arviz",
)
UNIT = "import jax, optimistix, scipy.stats"
"""What every command that fits needs: the unit of their seconds."""
FILLED = ", cache filled"
POINT = ["--pan-steps", "169", "--tilt-steps", "46", "--aperture-deg", "63.4"]
PROGRAM = [sys.executable, "-c", "from tvsbayes.cli.main import main; main()"]


def kept(out: Path) -> list[str]:
    """Folder of a fit's results, with output in JSON."""
    return ["--json", "--out", str(out / "results")]


def measure(bench: Bench) -> None:
    """Fresh processes only; the files they read are in the file cache."""
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.studies.executors import SINGLE_THREADED

    twin = str(shipped_data() / "twins" / "paper_twin")

    # Without what `experiments` sets: OpenBLAS' waiting threads are a fifth of what a user's bare import costs.
    plain = {name: value for name, value in os.environ.items() if name not in SINGLE_THREADED}

    def floor(code: str):
        return lambda _: command_cost([sys.executable, "-c", code], plain)[1]

    with tempfile.TemporaryDirectory() as place:
        out = Path(place)

        def command(arguments: Sequence[str], cache: Path | None):
            def row(_: int) -> dict[str, float]:
                with tempfile.TemporaryDirectory() as empty:
                    environment = {**plain, "TVSBAYES_CACHE": str(cache or empty)}
                    return command_cost([*PROGRAM, *arguments], environment)[1]

            return row

        floor_of = {code: floor(code) for code in IMPORTS}
        short = {
            "tvsbayes --help": command(["--help"], out),
            "tvsbayes check": command(["check", twin, "--json"], out),
            "tvsbayes classic": command(["classic", twin, "--json"], out),
        }
        for case, works in ((FLOOR, floor_of), (COMMANDS, short)):
            if bench.missing(case, list(works)):
                for work in works.values():
                    work(0)
                bench.interleaved(case, works)
        cold = {"tvsbayes fit --no-sample, cache empty": command(["fit", twin, "--no-sample", *kept(out)], None)}
        bench.interleaved(COMMANDS, cold, min(bench.repeats, COLD_REPEATS))
        fitted = str(out / "fitted")
        usual = {
            "fit --no-sample": ["fit", twin, "--no-sample", *kept(out)],
            "fit --quick": ["fit", twin, "--quick", *kept(out)],
            "demo": ["demo", "--json"],
            "fit": ["fit", twin, *kept(out)],
            "plan": ["plan", str(shipped_data() / "rigs" / "mounted" / "rig.toml"), "--json"],
            "locate": ["locate", fitted, *POINT, "--json"],
            "report": ["report", fitted, "--json"],
        }
        filled = out / "filled"
        warm = {UNIT: floor(UNIT)}
        warm |= {f"tvsbayes {name}{FILLED}": command(words, filled) for name, words in usual.items()}
        if bench.missing(COMMANDS, list(warm)):
            shutil.copytree(twin, fitted)
            command(["fit", fitted, "--json"], filled)(0)
            for work in warm.values():
                work(0)
            bench.interleaved(COMMANDS, warm)


def cases() -> list[Case]:
    """Tables of the part."""
    columns = (Column("wall_s", "wall s"), Column("cpu_s", "CPU s"), Column("rss_mib", "peak memory, MiB", "{:.0f}"))
    about = "On the shipped paper twin (384 spots)."
    return [Case(FLOOR, "`python -c ...`", columns, ours=""), Case(COMMANDS, about, columns, "cpu_s", UNIT)]
