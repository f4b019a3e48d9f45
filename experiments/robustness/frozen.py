"""What do commands print and write, before and after a change that must move nothing?

    python -m experiments.robustness.frozen write BEFORE [FOLDER ...]     # in the tree before the change
    python -m experiments.robustness.frozen write AFTER [FOLDER ...]      # in the tree after it
    python -m experiments.robustness.frozen compare BEFORE AFTER

`write` makes both shipped twins, four axes, two heads and a stereo pair, copies campaigns and axis folders of your own
(FOLDER), runs commands on all of them in this process and spoils files as users do. A file for each command holds what
was called, its exit code, what it printed and every file that it wrote, arrays by their first numbers and moments.
`compare` lists the differences, exit 1 if there are any: numbers may differ by `RELATIVE`, dates, seconds, versions and
hashes at will. Both runs belong on one machine: other processors round otherwise. `--only REGEX` takes some commands.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import io
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from experiments.common.command_line import act, parser
from experiments.common.rows import ROOT

RELATIVE, ABSOLUTE = 1e-9, 1e-12
"""Of numbers: the mode of a fit ends within 1e-10 of its u whatever the order of sums."""
FREE = (
    (r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:\d\d)?", "TIME"),
    (r"\b\d{4}-\d\d-\d\d\b", "DATE"),
    (r"\b[0-9a-f]{32,64}\b", "HASH"),
    (r"\b[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\b", "ID"),
    (r"\b[\d.]+ (s|min|seconds)\b", "SECONDS"),
    (r'"(seconds|cpu_s|wall_s|elapsed_s)": [\d.e-]+', r'"\1": SECONDS'),
    (r'"command": "tvsbayes [^"]*"|Command: tvsbayes write \S+', "COMMAND"),
    (r"\b(?=\d*[A-F])[0-9A-F]{12}\b|sha256-[\w+/=]+", "HASH"),
)
"""What two runs of one tree have otherwise."""
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")
TEXT = {".json", ".toml", ".csv", ".txt", ".md", ".html", ".h", ".urdf", ".yaml", ".comp", ".gcode", ".svg", ".xml", ""}

SCANNER = (
    *("check {}", "classic {}", "classic {} --json", "fit {} --no-sample --details", "fit {} --quick --seed 2 --json"),
    *("report {}", "locate {} --pan-steps 150 --tilt-steps 40 --aperture-deg 63 --budget --json", "view {}"),
    *("steps-for {} --azimuth-deg 5 --elevation-deg 3 --json", "steps-for {} --export json --out {}.calibration.json"),
    *("steps-for {} --export header --out {}.h", "plan {} --watch", "compare {}"),
    "compensate {} --to header -o {}.table.h",
)
AXIS = (
    *("check {}", "classic {}", "classic {} --json", "fit {} --details", "fit {} --json"),
    *("compare {} --by positions", "plan --given {}", "plan --given {} --json", "plan {} --watch", "report {}"),
    *("compensate {} --to csv -o {}.csv", "compensate {} --to linuxcnc -o {}.comp", "plan {} --verify"),
    "report {} --tolerance 0.05 --of A --out {}.html",
)
HEAD = ("check {}", "fit {} --quick", "fit {} --json", "report {}", "compensate {} --to urdf", "plan {} --watch")
ONCE = (
    *("plan mounted/rig.toml", "plan mounted/rig.toml --target 'U95(x) at 1000,0,0 mm <= 60 mm' --json"),
    *("simulate mounted/rig.toml mounted/mixed.csv made --aperture --seed 7", "check made", "classic made"),
    *("acquire mounted/rig.toml mounted/planned.csv run --simulate --centroids --seed 3", "check run"),
    *("export run --nexus run.nxs", "demo --json", "new empty", "new ax --axis"),
    *("new hd --mechanism pan-tilt", "stereo bumblebee2 --board 6x4 --pitch-mm 25 -o stereo.json"),
    *("fit", "-h"),
)
SPOILED = (
    ("paper", "spots.csv", r"(?m)^(\d+,[^,]*,)([\d.]+)", r"\1abc"),
    ("paper", "spots.csv", r"u_left_px", "u_px"),
    ("paper", "spots.csv", r"(?s)^(.*\n)(.*)$", r"\1"),
    ("paper", "moves.csv", r"(?m)^\d+,.*\n", ""),
    ("paper", "moves.csv", r",", ";"),
    ("paper", "moves.csv", r"\n", "\n\n\n"),
    ("paper", "campaign.toml", r"format", "fmt"),
    ("paper", "campaign.toml", r'"(tvsbayes-campaign)/\d+"', r'"\1/99"'),
    ("paper", "campaign.toml", r"=", "=="),
    ("paper", "stereo.json", r"\[", "[1e999, "),
    ("paper", "stereo.json", r"\{", "", 1),
    ("paper", "stereo.json", r'image_width": \d+', 'image_width": -1'),
    ("screw", "readings.csv", r"(?m)(,)([\d.]+)$", r"\1x"),
    ("screw", "readings.csv", r"move", "order"),
    ("screw", "moves.csv", r"command", "cmd"),
    ("screw", "moves.csv", r"(?m)^(\d+),0,", r"\1,-1,"),
    ("screw", "campaign.toml", r'unit = "[^"]*"', 'unit = "furlong"'),
    ("screw", "campaign.toml", r"\[axis\]", '[axis]\nper_command = "x"'),
    ("sky", "campaign.toml", r"mechanism", "mechanic"),
    ("sky", "moves.csv", r"(?m)^(\d+),", r"\1\1,"),
    ("sky", "rig.toml", r"=", "= nan #"),
)
"""A folder, its file, and what a substitution makes of it; `check` and `fit` are asked then."""


def screw(seed: int, unit: str, warm: bool, absolute: bool) -> str:
    """A table of an axis read up and down, by NumPy alone."""
    rng = np.random.default_rng(seed)
    travel, play, per = (300.0, 0.012, 1.0) if unit == "mm" else (360.0, 0.03, 0.01)
    # An encoder on the axis sees no play.
    lost, places = play * (not absolute), np.linspace(0, travel, 13) / per
    rows = []
    for cycle in range(3):
        for side, commands in (("forward", places), ("backward", places[::-1])):
            for command in commands:
                growth = 0.01 * (1 - np.exp(-len(rows) / 40)) if warm else 0.0
                wave = play / 3 * np.sin(2 * np.pi * command * per / (travel / 7))
                value = per * 1.0002 * command - lost * (side == "backward") + wave + growth + rng.normal(0, play / 20)
                more = [f"{20 + 2 * growth:.3f}"] if warm else []
                rows.append([f"{command:g}", f"{value:.5f}", side, f"{60 * len(rows)}", *more])
        if not absolute and cycle < 2:
            rows.append([])
    titles = ["command", f"reading_{unit}", "direction", "time_s", *(["temperature_degC"] if warm else [])]
    return "\n".join(",".join(row) for row in [titles, *filter(None, rows)]) + "\n"


def sky(seed: int, stars: int, encoders: bool) -> str:
    """Sightings of a head, by NumPy alone: of its counters, or of its encoders in deg."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(5, 350, stars), rng.uniform(15, 70, stars)
    per, titles = (1e-3, "pan_deg,tilt_deg") if encoders else (0.05, "pan_steps,tilt_steps")
    pan, tilt = (np.round((value + rng.normal(0, 0.01, stars)) / per) for value in (azimuth + 0.3, elevation - 0.2))
    pan, tilt = (value * per if encoders else value for value in (pan, tilt))
    rows = zip(pan, tilt, azimuth, elevation, strict=True)
    lines = [f"{p:.{3 * encoders}f},{t:.{3 * encoders}f},{a:.5f},{e:.5f}" for p, t, a, e in rows]
    return f"{titles},azimuth_deg,elevation_deg\n" + "\n".join(lines) + "\n"


def inputs(folders: list[Path]) -> Iterator[str]:
    """Make the inputs in the current folder; commands to run, in order."""
    data = ROOT / "data"
    for name in ("paper", "grid"):
        shutil.copytree(data / "twins" / f"{name}_twin", name)
    shutil.copytree(data / "rigs" / "mounted", "mounted")
    shutil.copytree(data / "real" / "stereo" / "bumblebee2", "bumblebee2")
    axes = {"screw": ("mm", False, False), "stage": ("mm", True, False), "table": ("deg", False, False)}
    for seed, (name, kind) in enumerate((axes | {"encoder": ("deg", True, True)}).items()):
        Path(f"{name}_log.csv").write_text(screw(seed, *kind))
        yield f"import {name}_log.csv --axis --to {name} --yes" + " --encoders output" * kind[2]
    for seed, (name, option) in enumerate({"sky": "", "mount": " --encoders motor"}.items()):
        Path(f"{name}_log.csv").write_text(sky(seed, 30, bool(option)))
        yield f"import {name}_log.csv --sightings --to {name} --yes{option}"
    own = [folder.name for folder in folders]
    for folder in folders:
        shutil.copytree(folder, folder.name)
    is_axis = {name: "tvsbayes-axis" in (Path(name) / "campaign.toml").read_text() for name in own}
    for name in (*axes, "encoder", *(name for name in own if is_axis[name])):
        yield from (command.replace("{}", name) for command in AXIS)
    for number, (name, file, old, new, *count) in enumerate(SPOILED):
        spoiled = Path(f"spoiled{number}")
        shutil.copytree(name, spoiled, ignore=shutil.ignore_patterns("results"))
        text = (spoiled / file).read_text()
        (spoiled / file).write_text(re.sub(old, new, text, count=count[0] if count else 0))
        yield from (f"check {spoiled}", f"check {spoiled} --json", f"fit {spoiled} --no-sample")
    for name in ("sky", "mount"):
        yield from (command.replace("{}", name) for command in HEAD)
    yield from ONCE
    for name in ("paper", "grid", *(name for name in own if not is_axis[name])):
        yield from (command.replace("{}", name) for command in SCANNER)


def shown(path: Path) -> str:
    """A file as text: arrays by their shapes, first numbers and moments, other bytes by their number."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            parts = {name: arrays[name] for name in sorted(arrays)}
        numbers = {name: part.astype(float) for name, part in parts.items() if part.dtype.kind in "iuf" and part.size}
        lines = [f"{name} {part.shape} {part.dtype}" for name, part in parts.items()]
        lines += [f"{name} {part.ravel()[:5].tolist()} {part.mean()} {part.std()}" for name, part in numbers.items()]
        return "\n".join(lines)
    if path.suffix in TEXT:
        return path.read_text(encoding="utf-8", errors="replace")
    return f"a file {path.suffix}"


def stamps() -> dict[Path, int]:
    """Files here, with the moments of their last change."""
    return {path: path.stat().st_mtime_ns for path in sorted(Path().rglob("*")) if path.is_file()}


def answered(command: str, run: Callable[[list[str]], int]) -> str:
    """What a command answers: code, output, files."""
    before, printed, said = stamps(), io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
        try:
            code: object = run(shlex.split(command))
        except BaseException as error:
            code = f"{type(error).__name__}: {error}"
    texts = {"stdout": printed.getvalue(), "stderr": said.getvalue()}
    parts = [f"$ tvsbayes {command}\nexit {code}", *(f"--- {stream}\n{text}" for stream, text in texts.items())]
    parts += [f"--- {path}\n{shown(path)}" for path, moment in stamps().items() if before.get(path) != moment]
    return "\n".join(parts).replace(str(Path().resolve()), "HERE").replace(str(ROOT), "TREE")


def write(arguments: argparse.Namespace) -> None:
    """Write a file for each command into a new folder."""
    out, folders = arguments.places[0].resolve(), [folder.resolve() for folder in arguments.places[1:]]
    out.mkdir(parents=True)
    os.environ["COLUMNS"], cache = "120", str(arguments.cache.resolve())
    from tvsbayes.cli.main import run

    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        os.environ["TVSBAYES_CACHE"] = cache
        for number, command in enumerate(inputs(folders)):
            if command.startswith("import") or re.search(arguments.only, command):
                print(number, command, flush=True)
                name = re.sub(r"[^\w.-]+", "_", command)[:60]
                (out / f"{number:03d}_{name}.txt").write_text(answered(command, run), encoding="utf-8")


def same(a: str, b: str) -> bool:
    """Whether two lines say the same: numbers within the tolerances, all else equal."""
    if NUMBER.sub("#", a) != NUMBER.sub("#", b):
        return False
    pairs = zip(NUMBER.findall(a), NUMBER.findall(b), strict=True)
    return all(abs(float(x) - float(y)) <= ABSOLUTE + RELATIVE * abs(float(x)) for x, y in pairs if x != y)


def lines_of(path: Path) -> list[str]:
    """Lines of an answer, without what two runs of one tree have otherwise."""
    text = path.read_text(encoding="utf-8")
    for pattern, word in FREE:
        text = re.sub(pattern, word, text)
    return text.splitlines()


def compare(arguments: argparse.Namespace) -> None:
    """List what differs, by command."""
    before, after = arguments.places
    names = sorted({path.name for path in [*before.iterdir(), *after.iterdir()]})
    moved = 0
    for name in names:
        if not (before / name).exists() or not (after / name).exists():
            print(f"{name}: only in one")
            moved += 1
            continue
        a, b = lines_of(before / name), lines_of(after / name)
        if len(a) == len(b):
            b = [x if x == y or same(x, y) else y for x, y in zip(a, b, strict=True)]
        if a == b:
            continue
        moved += 1
        changes = [line[:200] for line in difflib.unified_diff(a, b, lineterm="", n=0)][2:]
        print(f"== {name}: {len(changes)} lines", *changes[: arguments.lines], sep="\n")
    print(f"{moved} of {len(names)} differ")
    sys.exit(moved > 0)


def main() -> None:
    """Carry out one of the two actions."""
    cli = parser(__doc__, write=write, compare=compare)
    cli.add_argument("places", nargs="+", type=Path, help="the folder of answers, then folders; or two of answers")
    cli.add_argument("--only", default="", metavar="REGEX", help="commands to run, besides imports")
    cli.add_argument("--lines", type=int, default=12, help="lines of a difference that are shown (%(default)s)")
    cli.add_argument("--cache", type=Path, default=Path(".pytest_cache/frozen"), help="of compiled functions")
    act(cli)


if __name__ == "__main__":
    main()
