"""The paper's lab end to end: its pictures in folders, its lab book, Table 1.

    python -m experiments.paper.lab > experiments/paper/lab.md          # ten minutes

The shipped paper twin renders its 384 looks; the pictures are named as a lab names them (directions as folders or as a
prefix, the camera as a letter, a number or a Spanish word, experiments 1 to 24 in each direction) and listed in a book
with relative steps and the time of day. Then the commands of a user: `import --relative --pictures`, `detect`, `check`,
`classic`. Every picture in `frames/` is compared with the one that was rendered for that look.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
import time
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

from experiments.common.command_line import print_only
from experiments.common.page import heading
from experiments.common.paper_lab import LABS, write_lab
from experiments.common.rigs import mounted_rig, paper_values, shipped_plan, shipped_twin
from tvsbayes.cli.main import run
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import CAMERAS, frame_name, read_campaign
from tvsbayes.instrument.stereo_pair import write_stereo
from tvsbayes.twin.frames import write_frames
from tvsbayes.twin.simulated_campaign import simulate

SEED = 2025
SPOT_SD_PX = 0.05


def said(*words: object) -> dict:
    """The document of a command."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()):
        run([*map(str, words), "--json"])
    return json.loads(out.getvalue())


def misplaced(names: Mapping[int, tuple[str, str]], pictures: Path, mine: Path) -> int:
    """Number of pictures in `frames/` that are not those of their look; looks are numbered by the rows of the book."""
    looks = sorted(read_campaign(mine).spots, key=lambda spot: (spot.move, spot.spot))
    wrong = 2 * abs(len(looks) - len(names))
    for look, own in zip(looks, (names[spot] for spot in sorted(names)), strict=False):
        for side, name in zip(CAMERAS, own, strict=True):
            file = mine / frame_name(look.spot, side)
            wrong += not file.is_file() or file.read_bytes() != (pictures / name).read_bytes()
    return wrong


def main() -> None:
    print_only(__doc__)
    paper, twin = paper_values(), shipped_twin("paper_twin")
    simulated = simulate(mounted_rig(), shipped_plan("paper_twin"), SEED, twin.truth, spot_sd_px=SPOT_SD_PX)
    print("# The paper's lab end to end\n\nWritten by `python -m experiments.paper.lab`; deg/step.\n")
    with tempfile.TemporaryDirectory() as place:
        root, start = Path(place), time.perf_counter()
        write_frames(root, simulated, SEED)
        print(f"{len(simulated.campaign.spots)} looks rendered in {(time.perf_counter() - start) / 60:.1f} min.\n")
        print(heading("lab | looks | pictures misplaced | import, s | detect, s | found | check"))
        tables = {}
        for number, lab in enumerate(LABS):
            folder = root / f"lab{number}"
            folder.mkdir()
            names = write_lab(lab, simulated.campaign, root, folder)
            mine, seconds = folder / "mine", [time.perf_counter()]
            book = "import", folder / "book.csv", "--to", mine, "--relative", "--pictures", folder / "pictures", "--yes"
            imported = said(*book)
            seconds.append(time.perf_counter())
            write_stereo(simulated.campaign.stereo_pair, mine / "stereo.json")
            detected = said("detect", mine)
            seconds.append(time.perf_counter())
            tables[lab.name] = said("classic", mine)
            check = "error" if "error" in said("check", mine) else "read"
            wrong = misplaced(names, folder / "pictures", mine)
            took = " | ".join(f"{after - before:.0f}" for before, after in pairwise(seconds))
            print(f"| {lab.name} | {imported['spots']} | {wrong} | {took} | {detected['ok']} | {check} |", flush=True)
            shutil.rmtree(folder)
    print("\n" + heading("direction | n | mean | sd | same in all labs | paper: mean | sd"))
    first = next(iter(tables.values()))["directions"]
    for way in DIRECTIONS:
        same = all(table["directions"][way] == first[way] for table in tables.values())
        own, (_, mean, sd) = first[way], paper[way]
        shown = f"{own['n']} | {own['mean_deg_per_step']:.6f} | {own['sd_deg_per_step']:.6f}"
        print(f"| {way} | {shown} | {'yes' if same else 'NO'} | {mean:.6f} | {sd:.6f} |")
    print("\nThe twin is the rig that was solved for the Table, run again under another seed and seen by pictures;")
    print("[table 1](table1.md) says how much that scatters.")


if __name__ == "__main__":
    main()
