"""Do random hosts and benches bring the firmware's core to break a promise?

    python -m experiments.firmware.core_fuzz run --seconds 600 --seed 1000000 > experiments/firmware/core_fuzz.md

Builds `core_fuzz.cpp` with g++ under ASan and UBSan and runs it: sessions of valid, damaged and random lines, lost
steps, spikes and broken wires at the switches, stalls of the main loop. After every byte and every loop it holds the
core to its promises; a violation ends the run with the seed of its input.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from experiments.common.command_line import act, parser
from experiments.common.rows import commit
from tvsbayes.positioner import firmware_folder

SOURCE = Path(__file__).with_suffix(".cpp")
PROMISES = """\
- Light: none before it was ordered, none unhomed or in alarm, none 2 s after the last request that was obeyed; a reply
  says what the line does.
- Steps: only while the last reply said `moving`, never while receiving, at most one of an axis in a loop, never two
  within 50 us.
- Targets: as ordered, within the soft limits as they were set; at most 202 steps of an axis with its limit open.
- Replies: form and CRC of every line; at rest the counters stand on the targets.
"""


def run(arguments: argparse.Namespace) -> None:
    """Builds, runs, prints the page."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "fuzz"
        sanitizers = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
        core = firmware_folder() / "tvs_positioner"
        command = ["g++", "-std=c++17", "-O1", "-g", "-Wall", "-Wextra", *sanitizers, f"-I{core}", SOURCE]
        subprocess.run([*command, *sorted(core.glob("tvs_*.cpp")), "-o", program], check=True)
        limits = [str(program), str(arguments.seed), str(arguments.seconds)]
        result = subprocess.run(limits, capture_output=True, text=True, check=False)
    print("# Fuzz of the firmware's core\n")
    print(f"Commit {commit()}, g++, ASan and UBSan, {arguments.seconds} s, first seed {arguments.seed}.\n")
    print("What was held after every byte and every loop:\n")
    print(PROMISES)
    print(result.stdout.strip().splitlines()[-1] if result.stdout.strip() else result.stderr[-2000:])
    sys.exit(result.returncode)


if __name__ == "__main__":
    cli = parser(__doc__, run=run)
    cli.add_argument("--seconds", type=int, default=600, help="how long (%(default)s)")
    cli.add_argument("--seed", type=int, default=1, help="of the first input (%(default)s)")
    act(cli)
