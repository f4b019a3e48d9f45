"""What a file becomes, kind by kind: the page of the documentation, with what the commands print.

    python -m experiments.inputs.you_have > data/docs/you-have.md

Files are those of `tests/data/foreign` and `data/`, or are drawn here from stated numbers. The default tests run the
commands that take a second or two and compare.
"""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.common.command_line import print_only
from experiments.common.commands import console, quietly
from experiments.common.paper_lab import LABS, write_lab
from experiments.common.rigs import mounted_rig
from experiments.common.rows import ROOT
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.plan import PlanBuilder, write_plan
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.stereo_pair import write_stereo
from tvsbayes.twin.frames import write_frames
from tvsbayes.twin.simulated_campaign import simulate

FOREIGN, DATA = ROOT / "tests" / "data" / "foreign", ROOT / "data"
TWIN = DATA / "twins" / "grid_twin"
SEED = 3
WORM_S, WORM_ARCSEC = 240.0, 8.0
"""Period and amplitude of the drawn mount."""
STEP_DEG, PLAY_DEG, SCATTER_DEG = 360 / 3200, 0.3, 0.01
"""Of the drawn stages."""


def rows_of(table: Path) -> list[dict[str, str]]:
    """Rows of a CSV file by the names of its columns."""
    return list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))


def looks() -> str:
    """Counters and centres of a twin in one sheet, as a spreadsheet with decimal commas saves it."""
    spots = {row["move"]: row for row in rows_of(TWIN / "spots.csv")}
    lines = ["Pan (steps);Tilt (steps);Sheet;x left;y left;x right;y right"]
    for row in rows_of(TWIN / "moves.csv"):
        spot = spots.get(row["move"])
        pixels = [spot[f"{axis}_{side}_px"] for side in ("left", "right") for axis in "uv"] if spot else []
        cells = [spot["target"], *(f"{float(cell):.2f}".replace(".", ",") for cell in pixels)] if spot else [""] * 5
        lines.append(";".join([row["pan_steps"], row["tilt_steps"], *cells]))
    return "\n".join(lines) + "\n"


def night(frames: int) -> str:
    """A run of PHD2: a worm's error, and pulses against it that act after their frame."""
    pixel, rate, declination = 2.0, 3.0, 40.0
    cosine, rng, pulsed = math.cos(math.radians(declination)), np.random.default_rng(SEED), 0.0
    lines = [
        "Guiding Begins at 2026-01-02 21:00:00",
        f"Pixel scale = {pixel} arc-sec/px, Binning = 1, Focal length = 500 mm",
        f"Mount = A Mount,  connected, guiding enabled, xAngle = 1.0, xRate = {rate}, yAngle = 2.0, yRate = 3.0",
        "RA Guide Speed = 6.1 a-s/s, Dec Guide Speed = 7.5 a-s/s, Cal Dec = 0.0",
        f"RA = 20.34 hr, Dec = {declination} deg, Hour angle = -1.70 hr, Pier side = West, Rotator pos = N/A",
        "Frame,Time,mount,dx,dy,RARawDistance,DECRawDistance,RAGuideDistance,DECGuideDistance,RADuration,RADirection,"
        "DECDuration,DECDirection,XStep,YStep,StarMass,SNR,ErrorCode",
    ]
    for k in range(1, frames + 1):
        motion = WORM_ARCSEC * math.sin(2 * math.pi * 3.0 * k / WORM_S) - pulsed
        raw = motion * cosine / pixel + rng.normal(0, 0.1)
        ms = min(round(abs(raw) * 120), 800)
        lines.append(f'{k},{3 * k},"Mount",0,0,{raw:.3f},0,0,0,{ms},{"W" if raw > 0 else "E"},0,,,,900,30.0,0')
        pulsed += math.copysign(ms / 1000 * rate * pixel, raw)
    return "\n".join([*lines, "Guiding Ends at 2026-01-02 21:30:00", ""])


def guide_log() -> str:
    """Two runs in one file."""
    return night(20) + "\n" + night(400)


def visits(runs: int = 3, stops: int = 9, every: int = 400) -> list[tuple[int, float]]:
    """Counter and angle of a stage that is driven up and down: a constant ratio, play, scatter."""
    rng = np.random.default_rng(SEED)
    ways = [(every * k, side) for side in (1, -1) for k in range(stops)[::side]]
    return [(c, STEP_DEG * c - side * PLAY_DEG / 2 + rng.normal(0, SCATTER_DEG)) for c, side in ways * runs]


def camonitor() -> str:
    """The same as two series of EPICS: counters during each motion of 1 s, the encoder 4 s later."""
    lines, before = [], -400
    for k, (counter, angle) in enumerate(visits()):
        clock = f"2026-07-09 10:{20 + k // 6:02d}:{k % 6}"
        for tenth in range(10):
            lines.append(f"T:Axis1-PosAct {clock}0.{tenth}00000 {before + (counter - before) * (tenth + 1) // 10}")
        lines.append(f"T:Enc1 {clock}5.000000 {angle:.4f}")
        before = counter
    # Counters are logged on, or the last reading has none after it.
    return "\n".join([*lines, f"T:Axis1-PosAct 2026-07-09 11:00:00.000000 {before}"]) + "\n"


def data_logger() -> bytes:
    """The same as Klipper's `data_logger.py` writes it: steps of a stepper in bursts, angles of a sensor."""
    rng, ticks, rate = np.random.default_rng(SEED), 500, 1e6
    messages, angles, clock, at = [{"q": "status", "toolhead": {}}], [], 1_000_000, 0
    for burst in (3200, -3200) * 3:
        last = clock + (abs(burst) - 1) * ticks
        times = {"first_step_time": clock / rate, "last_step_time": last / rate, "step_distance": 0.01}
        stamps = {"first_clock": clock, "last_clock": last, "start_mcu_position": at}
        queue = {**stamps, **times, "data": [[ticks, burst, 0]]}
        messages.append({"q": "stepq:stepper_x", "params": queue})
        for count in range(200, abs(burst), 200):
            side = math.copysign(1, burst)
            turned = (at + side * count) / 3200 - side * PLAY_DEG / 720 + rng.normal(0, SCATTER_DEG) / 360
            angles.append([(clock + (count - 0.5) * ticks) / rate, 65536 * turned])
        at, clock = at + burst, last + 2_000_000
    messages.append({"q": "angle:my_sensor", "params": {"data": angles, "errors": 0}})
    return b"\x03".join(json.dumps(message).encode() for message in messages) + b"\x03"


def spots() -> None:
    """Pictures of a short plan's looks, drawn by the twin, and a campaign with the moves that waits for them."""
    rows = (DATA / "rigs" / "mounted" / "grid.csv").read_text(encoding="utf-8").splitlines()[:14]
    Path("plan.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    quietly("simulate", str(DATA / "rigs" / "mounted" / "rig.toml"), "plan.csv", "drawn", "--frames")
    quietly("new", "mine")
    for name in ("moves.csv", "stereo.json"):
        shutil.copy(Path("drawn") / name, Path("mine") / name)
    Path("pictures").mkdir()
    moves = [row["move"] for row in rows_of(Path("drawn/spots.csv"))]
    for path in sorted(Path("drawn/frames").glob("*.png")):
        spot, side = path.stem.split("_")
        shutil.copy(path, f"pictures/{side}_{int(moves[int(spot)]):03d}.png")


def lab_book() -> bytes:
    """The lab book of two experiments in every direction, and their pictures in folders of directions, by the twin."""
    run = simulate(mounted_rig(), four_point_protocol(2), SEED)
    write_frames(Path(), run, SEED)
    write_lab(LABS[0], run.campaign, Path(), Path())
    Path("mine").mkdir()
    write_stereo(run.campaign.stereo_pair, Path("mine/stereo.json"))
    return Path("book.csv").read_bytes()


def sightings() -> None:
    """A log of a head whose nominal geometry is that of the URDF, and looks of the same head later; by the twin."""
    quietly("import", "--urdf", "unit.urdf", "--to", "nominal", "--steps-per-turn", "200", "--yes")
    grid = [(pan, tilt) for pan in range(-900, 901, 300) for tilt in (-150, 50, 250, 450)]
    order = [grid[k] for _ in range(2) for k in np.random.default_rng(SEED).permutation(len(grid))]
    again = [(sign * pan, sign * tilt) for pan, tilt in ((700, 300), (200, 100), (-600, 200)) for sign in (1, -1)]
    for name, places in (("measured", order), ("fresh", again)):
        plan = PlanBuilder()
        plan.home()
        for place in places:
            plan.move(*place)
            plan.look()
        write_plan(plan.steps, Path("plan.csv"), SIGHTING_HEAD)
        quietly("simulate", "nominal/rig.toml", "plan.csv", name, "--seed", str(SEED))
    rows = {row["move"]: row for row in rows_of(Path("measured/sightings.csv"))}
    lines = ["time_s,pan_steps,tilt_steps,azimuth_deg,elevation_deg,u_deg"]
    for row in rows_of(Path("measured/moves.csv")):
        sighting = rows.get(row["move"], {})
        cells = [row[name] for name in ("time_s", "pan_steps", "tilt_steps")]
        cells += [sighting.get(name, "") for name in ("azimuth_deg", "elevation_deg", "u_deg")]
        lines.append(",".join(cells))
    Path("log.csv").write_text("\n".join([*lines, ""]), encoding="utf-8")


def boards() -> None:
    """The pairs that are shipped, of another camera."""
    shutil.copytree(DATA / "real" / "stereo" / "bumblebee2", "pictures")


class Command(NamedTuple):
    """What follows `tvsbayes`; how many of the last and of the first lines are shown; whether the tests run it."""

    line: str
    last: int = 0
    first: int | None = None
    quick: bool = True


@dataclass(frozen=True)
class Kind:
    """A kind of file: title and text of its section, commands, files by what they are copied or written from.

    `lines` of the first file are shown; `before` prepares what else is needed.
    """

    title: str
    text: str
    commands: tuple[Command, ...]
    files: dict[str, Path | Callable[[], str | bytes]] = field(default_factory=dict)
    lines: int = 0
    before: Callable[[], None] | None = None

    def put(self) -> None:
        """The files, into the working directory."""
        for name, source in self.files.items():
            place = Path(name)
            place.parent.mkdir(exist_ok=True, parents=True)
            content = source.read_bytes() if isinstance(source, Path) else source()
            place.write_bytes(content.encode() if isinstance(content, str) else content)
        if self.before is not None:
            self.before()

    def blocks(self, *, quick: bool = False) -> Iterator[str]:
        """The first lines of the file, and each command with what it prints; up to the first longer one if `quick`."""
        if quick and not self.commands[0].quick:
            return
        self.put()
        if self.lines:
            text = Path(next(iter(self.files))).read_text(encoding="utf-8").splitlines()
            yield "```text\n" + "\n".join(line[:110] for line in text[: self.lines]) + "\n...\n```\n"
        for command in self.commands:
            if quick and not command.quick:
                return
            yield console(*command.line.split(), last=command.last, first=command.first)


def longer(line: str, last: int = 0, first: int | None = None) -> Command:
    """What the tests leave out: its last digits may differ with the versions of libraries."""
    return Command(line, last=last, first=first, quick=False)


def answered(line: str) -> Command:
    """The answer of an axis: what a fit prints first."""
    return longer(line, first=2)


KINDS = (
    Kind(
        "A table of counters and centroids",
        "A row for each look or move, of a spreadsheet or of a script; names of columns in English, German, Spanish\n"
        "or French. The calibration of the cameras stands beside it; it comes from any of the files below.",
        (
            Command("import looks.csv --to mine --yes"),
            Command("stereo --import cameras.json -o mine/stereo.json", 1),
            Command("check mine"),
            longer("fit mine --quick", 6),
        ),
        {"looks.csv": looks, "cameras.json": TWIN / "stereo.json"},
        5,
    ),
    Kind(
        "A stereo calibration of OpenCV",
        "FileStorage (YAML, XML, JSON), `.npz` or `.mat`, under any of the usual names. RMS and number of views are\n"
        "those of OpenCV's calibration; they make the covariance that such a file lacks.",
        (
            Command("stereo --import pair.yml --rms-px 0.25 --views 20 -o stereo.json"),
            Command("stereo --import stereo.json --export ros -o again.json", 3),
        ),
        {"pair.yml": FOREIGN / "opencv_other_names" / "pair2.yml"},
        5,
    ),
    Kind(
        "A stereo calibration of ROS, Kalibr or EuRoC",
        "A file, or one for each camera. Kalibr's camchain is one file, read likewise; so are mrcal's `.cameramodel`, "
        "and the files of\nBasalt, calib.io and Metashape.",
        (
            Command("stereo --import left.yaml --import right.yaml -o ros.json", 6),
            Command("stereo --import cam0.yaml --import cam1.yaml -o euroc.json", 6),
        ),
        {
            "left.yaml": FOREIGN / "ros_message_dump" / "left.yaml",
            "right.yaml": FOREIGN / "ros_message_dump" / "right.yaml",
            "cam0.yaml": FOREIGN / "euroc_sensor_pair" / "cam0.yaml",
            "cam1.yaml": FOREIGN / "euroc_sensor_pair" / "cam1.yaml",
        },
    ),
    Kind(
        "A calibration by a camera's maker",
        "DepthAI's EEPROM as JSON (`eepromToJsonFile`), a ZED's `SN*.conf`, what RealSense's\n"
        "`rs-enumerate-devices -c` prints; BoofCV's `stereo.yaml` likewise. `--image-size` is that of the\n"
        "pictures that show the spots.",
        (
            Command("stereo --import calib.json -o oak.json", 7),
            Command("stereo --import SN1.conf --image-size 1280x720 -o zed.json", 6),
            Command("stereo --import enumerate.txt --image-size 640x480 -o realsense.json", 7),
        ),
        {
            "calib.json": FOREIGN / "depthai" / "calib.json",
            "SN1.conf": FOREIGN / "zed" / "SN1.conf",
            "enumerate.txt": FOREIGN / "realsense" / "enumerate.txt",
        },
    ),
    Kind(
        "Pictures of a checkerboard",
        "Eleven real pairs of a Bumblebee2 camera (`data/real/stereo`), named `left01.jpg` and `right01.jpg`. A board\n"
        "of another size than stated is seen. Names that do not pair up: `--pair order`, or `--left` and `--right`. A\n"
        "ChArUco board, which may be partly outside: `--charuco 15x10 --dictionary 5X5_100` in place of `--board`.",
        (
            longer("stereo pictures --board 7x5 --pitch-mm 30 -o stereo.json"),
            longer("stereo pictures --board 6x4 --pitch-mm 30 -o stereo.json"),
        ),
        before=boards,
    ),
    Kind(
        "Pictures of spots",
        "`left_003.png` and `right_003.png` show the spot after move 3. `mine` is from `tvsbayes new mine`, with the\n"
        "counters in `moves.csv` and with `stereo.json`.",
        (longer("new mine --pictures pictures"), longer("detect mine")),
        before=spots,
    ),
    Kind(
        "A lab book and its pictures",
        "As in the paper: `pictures` holds folders left, right, up and down, cameras are `_L` and `_R`, experiments\n"
        "count from 1 in each direction, steps are those of each move. `mine` holds `stereo.json`. More of\n"
        "[lab books](campaign-files.md#lab-books).",
        (
            longer("import book.csv --to mine --relative --pictures pictures --yes"),
            longer("detect mine"),
            longer("classic mine"),
        ),
        {"book.csv": lab_book},
        7,
    ),
    Kind(
        "A robot's head: its URDF and a log",
        "Counters of both motors, and where its camera was found to point. `fresh` are later looks at counters of\n"
        "`steps-for`, with the calibration in force. More of [heads](head.md).",
        (
            Command("import --urdf unit.urdf --to head --steps-per-turn 200 --yes"),
            Command("import log.csv --sightings --to head --yes"),
            longer("fit head --quick"),
            longer("compensate head --to urdf -o new.urdf"),
            longer("verify head fresh"),
        ),
        {"unit.urdf": ROOT / "tests" / "head" / "unit.urdf"},
        before=sightings,
    ),
    Kind(
        "A dial gauge: runs side by side",
        "A sheet with a column for each run. Of deviations from the positions, also in µm: `--deviations`.",
        (Command("import dial.csv --axis --to dial --yes"), answered("fit dial --quick")),
        {"dial.csv": FOREIGN / "wide_forward_backward" / "dial.csv"},
        4,
    ),
    Kind(
        "An encoder that counts to 4096 and begins anew",
        "Whole turns are added; `--counts-per-turn` states another number, where it is no power of two.",
        (Command("import log.csv --axis --to encoder --yes"), answered("fit encoder --quick")),
        {"log.csv": FOREIGN / "counts_wrap" / "log.csv"},
        4,
    ),
    Kind(
        "Target, actual and error",
        "A column that is actual less target is no uncertainty: it is set aside.",
        (Command("import errors.csv --axis --to rotary --yes"), answered("fit rotary --quick")),
        {"errors.csv": FOREIGN / "error_column_as_u" / "signed.csv"},
        4,
    ),
    Kind(
        "A guide log of PHD2",
        "Its runs are listed; `--run` takes one. The readings are those of a mount that nobody had guided.",
        (
            Command("import PHD2_GuideLog.txt --axis --to mount"),
            Command("import PHD2_GuideLog.txt --axis --to mount --run 2 --yes"),
            longer("fit mount --quick"),
        ),
        {"PHD2_GuideLog.txt": guide_log},
        7,
    ),
    Kind(
        "Series of EPICS",
        "What `camonitor` prints. Each reading gets the command of its time; where the names leave open which series\n"
        "is which, `--column command=NAME --column value=NAME`.",
        (Command("import camonitor.log --axis --to stage --yes"), answered("fit stage --quick")),
        {"camonitor.log": camonitor},
        4,
    ),
    Kind(
        "Klipper",
        "A log of `data_logger.py` with a stepper and an angle sensor, packed or not; what `ANGLE_CALIBRATE` saved in\n"
        "`printer.cfg` is read likewise.",
        (Command("import klipper.json --axis --to stepper --yes"), answered("fit stepper --quick")),
        {"klipper.json": data_logger},
    ),
)


def main() -> None:
    print_only(__doc__)
    page = [BEGIN]
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as place:
            os.chdir(place)
            page += [f"## {kind.title}\n\n{kind.text}\n", *kind.blocks()]
            os.chdir(ROOT)
    print("\n".join(page).rstrip())


BEGIN = """# You have ...

Two commands for each kind of file, with what they print. `import` shows what it took for what, and asks before it
writes; `--yes` is the answer. `| head -2` and `| tail -4` show the first or last lines only. The files are small ones
of own numbers or drawn (`experiments.inputs.you_have` prints the page again); options and other kinds are those of
[import](commands.md#import), [stereo](commands.md#stereo) and [new](commands.md#new). Afterwards: `tvsbayes calibrate`,
the [report](commands.md#report), and for an axis [a table for its controller](compensation.md).
"""

if __name__ == "__main__":
    main()
