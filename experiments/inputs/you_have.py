"""What a file becomes, kind by kind: a page of the documentation, with what its commands print now.

    python -m experiments.inputs.you_have [--write]

The page, data/docs/you-have.md, has the words and the commands. Files are those of `tests/data/foreign` and `data/`, or
are drawn here from stated numbers. The default tests run the commands that take a second or two and compare.
"""

from __future__ import annotations

import contextlib
import csv
import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.common.commands import quietly, renew_page, renewed
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
PAGE = DATA / "docs" / "you-have.md"
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


def sightings() -> str:
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
    return "\n".join([*lines, ""])


FILES: dict[str, dict[str, Path | Callable[[], str | bytes | None]]] = {
    "A table of counters and centroids": {"looks.csv": looks, "cameras.json": TWIN / "stereo.json"},
    "A stereo calibration of OpenCV": {"pair.yml": FOREIGN / "opencv_other_names" / "pair2.yml"},
    "A stereo calibration of ROS, Kalibr or EuRoC": {
        "left.yaml": FOREIGN / "ros_message_dump" / "left.yaml",
        "right.yaml": FOREIGN / "ros_message_dump" / "right.yaml",
        "cam0.yaml": FOREIGN / "euroc_sensor_pair" / "cam0.yaml",
        "cam1.yaml": FOREIGN / "euroc_sensor_pair" / "cam1.yaml",
    },
    "A calibration by a camera's maker": {
        "calib.json": FOREIGN / "depthai" / "calib.json",
        "SN1.conf": FOREIGN / "zed" / "SN1.conf",
        "enumerate.txt": FOREIGN / "realsense" / "enumerate.txt",
    },
    "Pictures of a checkerboard": {"pictures": DATA / "real" / "stereo" / "bumblebee2"},
    "Pictures of spots": {"plan.csv": spots},
    "A lab book and its pictures": {"book.csv": lab_book},
    "A robot's head: its URDF and a log": {"unit.urdf": ROOT / "tests" / "head" / "unit.urdf", "log.csv": sightings},
    "A dial gauge: runs side by side": {"dial.csv": FOREIGN / "wide_forward_backward" / "dial.csv"},
    "An encoder that counts to 4096 and begins anew": {"log.csv": FOREIGN / "counts_wrap" / "log.csv"},
    "Target, actual and error": {"errors.csv": FOREIGN / "error_column_as_u" / "signed.csv"},
    "A guide log of PHD2": {"PHD2_GuideLog.txt": guide_log},
    "Series of EPICS": {"camonitor.log": camonitor},
    "Klipper": {"klipper.json": data_logger},
}
"""Of each section: files by what they are copied from or made by; the first is shown, and a maker may leave more."""
SAMPLES = re.compile(r"```console\n\$ tvsbayes (?!import|stereo --import|check)")
"""Where the first command stands that takes more than a second or two."""


def sections(page: str) -> dict[str, str]:
    """The sections of the page by their titles; "" is what stands before the first."""
    begin, *parts = page.split("\n## ")
    return {"": begin} | {part.partition("\n")[0]: part for part in parts}


def shown(title: str, part: str) -> str:
    """A section or its beginning with what is printed now, in an empty working directory."""
    for name, source in FILES[title].items():
        if isinstance(source, Path):
            (shutil.copytree if source.is_dir() else shutil.copy)(source, name)
        elif content := source():
            Path(name).write_bytes(content.encode() if isinstance(content, str) else content)
    return renewed(part, FILES[title])


def every(page: str) -> str:
    """The page, each section in a folder of its own."""
    parts = sections(page)
    for title in FILES:
        Path(title).mkdir()
        with contextlib.chdir(title):
            parts[title] = shown(title, parts[title])
    return "\n## ".join(parts.values())


if __name__ == "__main__":
    renew_page(__doc__, PAGE, every)
