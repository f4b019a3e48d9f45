"""Which numbers does 0.3.0 give otherwise than 0.2.0, and why?

    python -m experiments.robustness.moved_numbers run [FOLDER ...]     # campaigns and axis folders of your own beside
    python -m experiments.robustness.moved_numbers table > experiments/robustness/moved_numbers.md

`run` runs both releases on the same files, those of 0.2.0, and keeps their documents in
`experiments/output/robustness/moved_numbers/`; what is there is not run again. 0.3.0 is run three times: as it is
(`default`), with the statements that take creep and scatter of looks out of its model (`alike`), and in the folders
that 0.2.0 left, with its `results/`, exports and tables (`reads`). `table` compares the numbers at the same place of
both documents; entries of a list belong together by their names, rows of a report's tables by their labels.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

from experiments.common.command_line import act, parser
from experiments.common.releases import NAME_BEFORE, environment_of, tree_before
from experiments.common.rows import ROOT, commit, output

PLACE = output(__file__, "moved_numbers")
ASKED = {
    "default": "As it is",
    "alike": "Without creep and scatter of looks",
    "reads": "From results, exports and tables that 0.2.0 left",
}
EVERY, FRESH, ONCE = tuple(ASKED), ("default", "alike"), ("default",)
TAKEN_OUT = {
    "rig.prior": ('"look_scatter_deg.pan"', '"look_scatter_deg.tilt"', '"creep_deg.pan"', '"creep_deg.tilt"'),
    "axis": ("creep",),
}
"""By table of a file: what 0.3.0 models beyond 0.2.0, and what value and u of 0 take out."""
POINT, LIMITS = "--pan-steps 169 --tilt-steps 46 --aperture-deg 63.385", "--limit-deg-per-step 4e-4 --limit-mm 50"
EXPORTED = (
    "import json, tvsbayes; found = tvsbayes.load_calibration('calibration.json').locate(169, 46, 63.385);"
    "print(json.dumps([found.xyz_mm.tolist(), found.covariance_mm2.tolist()]))"
)
FITS = ("classic {}", "fit {} --no-sample", "fit {} --quick")
"""Of every campaign and axis folder."""
COMMANDS = {
    "fit trial --no-sample": FRESH,
    f"locate trial --budget {POINT}": EVERY,
    f"locate paper --budget {POINT}": EVERY,
    "steps-for trial --x-mm 500 --y-mm 150 --z-mm 40": EVERY,
    "steps-for trial --azimuth-deg 10 --elevation-deg 5": EVERY,
    "steps-for trial --export json --out calibration.json": FRESH,
    "load_calibration calibration.json": EVERY,
    "compare trial": EVERY,
    "compare paper": EVERY,
    "compare trial night": EVERY,
    "plan rig/rig.toml": FRESH,
    "plan rig/rig.toml --given trial --aperture --target 'u(worst) <= 8e-5 deg/step'": EVERY,
    "plan trial --watch": EVERY,
    "watch trial night --append nights.csv": EVERY,
    f"report trial {LIMITS}": EVERY,
    f"report paper {LIMITS}": EVERY,
    "check run": ONCE,
    "acquire rig/rig.toml rig/planned.csv run --simulate --centroids --resume --seed 3": ONCE,
    "demo": ONCE,
    "simulate SHIPPED/rig.toml SHIPPED/mixed.csv made --aperture --seed 7": ONCE,
}
LEFT = {
    "simulate": ("{3}/truth.json", "{3}/moves.csv", "{3}/spots.csv"),
    "acquire": ("{3}/moves.csv", "{3}/spots.csv"),
    "report": ("{1}/results/report.html",),
}
"""Files that are part of what a command answers."""
NAMES = ("name", "parameter", "quantity", "what", "cause", "axis", "position", "direction")
"""Keys that identify entries of a list."""
SAID = ("verdict", "answer", "passed", "cause", "converged", "estimator", "tier", "met", "code")
FREE = r"weak_directions|prior_conflicts|report\.html"
"""Parts whose keys follow from the data."""
NOISE = r"weak_directions|contraction|correlation"
HEADLINE = r"effective_.*(left|right|up|down|pan|tilt)$|effective_per_command|parameters\.backlash"
COLUMNS = (
    *("command", "equal", "largest relative difference", "estimates: by u", "by Monte Carlo errors"),
    *("u over that of 0.2.0, headlines", "else", "cause"),
)
SHIFTED = "creep and scatter of looks in the model: scatter takes its part of the pixel noise, creep widens contrasts"
MODE = "the mode's last digits, and other draws"
READ = "read as they are; merged formulas round otherwise, most in a difference of two ends"
CAUSES = (
    ("alike", "fit axis.*no-sample", "rounding turns eigenvectors, of which draws are made"),
    ("alike", "no-sample", "the descent ends elsewhere in its tolerance; u from other draws"),
    ("alike", "--quick|report paper|report axis", "another sampler of one posterior: Monte Carlo error"),
    ("alike", "plan rig", "the search ends a step beside; other instruments drawn"),
    ("alike", "compare", "u of terms from 128 other draws"),
    ("alike", "", MODE),
    ("reads", "locate|steps-for|load", READ),
    ("reads", "report axis", "0.2.0 had no creep: fitted anew"),
    ("reads", "report", "results as they are; the hold-out of `compare` is that of its new fit"),
    ("reads", "", "0.2.0 had no creep and no scatter: fitted anew, as by default"),
    ("default", "fit axis|report axis", "creep in the model, since the moves have times"),
    ("default", "grid", f"{SHIFTED}; tests of the residuals leave out what a creep could explain"),
    ("default", "acquire", "the rig states no scatter of its true looks: new looks scatter, the journal's are equal"),
    ("default", "", SHIFTED),
)
"""Asked how, of which command, why."""
HEADER = """# Numbers of {before} that 0.3.0 gives otherwise

Written by `python -m experiments.robustness.moved_numbers table`; 0.3.0 is commit {commits}. Numbers stand at the same
place of both documents; `equal`: to the last bit. Differences of estimates are the largest, in u of {before} and, where
both are sampled, in joint Monte Carlo errors: among a hundred estimates 2 to 3 of these are chance. The largest
relative difference leaves out contractions and loadings, which are differences near zero. `paper` and `grid` are the
shipped twins, `trial` is the tutorial's campaign, `campaign1`, `axis4` ... are folders given to `run`. Keys that are
gone and verdicts that changed stand under `else`: where it is empty there are none."""


def _content(path: Path) -> Any:
    """What a file holds, by names; numbers of a page are as printed."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        return json.loads(text)
    if path.suffix == ".csv":
        rows = csv.DictReader(text.splitlines())
        return [{k: float(v) if re.fullmatch(r"-?\d.*\d|\d", v) else v for k, v in row.items()} for row in rows]
    labelled: dict[str, list] = {}
    for row in re.findall(r"<tr.*?</tr>", text, re.DOTALL):
        cells = [re.sub(r"<[^>]*>|\s+", " ", cell).strip() for cell in re.findall(r"<t[dh].*?</t[dh]>", row, re.DOTALL)]
        if numbers := re.findall(r"\d+\.?\d*(?:e[-+]?\d+)?", " ".join(cells[1:])):
            labelled.setdefault(cells[0], []).append(numbers)
    return labelled


def _answer(line: str, folder: Path, tree: Path) -> dict[str, Any]:
    """What a release answers in a folder."""
    words = shlex.split(line.replace("SHIPPED", str(tree / "data/rigs/mounted")))
    program = ("-c", EXPORTED) if words[0] == "load_calibration" else ("-m", "tvsbayes", *words, "--json")
    environment = environment_of(tree, PLACE / f"cache {tree.name}")
    done = subprocess.run((sys.executable, *program), cwd=folder, env=environment, capture_output=True, text=True)
    answer = {"code": done.returncode, "warned": done.stderr[-2000:], "printed": json.loads(done.stdout or "{}")}
    left = [folder / name.format(*words) for name in LEFT.get(words[0], ())]
    return answer | {path.name: _content(path) for path in left if path.exists()}


def _files(base: Path, before: Path, folders: list[Path]) -> None:
    """The inputs of both releases: shipped files of 0.2.0, what it simulates and leaves half done, and your own."""
    for name, at in (("paper", "twins/paper_twin"), ("grid", "twins/grid_twin"), ("rig", "rigs/mounted")):
        shutil.copytree(before / "data" / at, base / name)
    for number, folder in enumerate(folders, start=1):
        kind = "axis" if "tvsbayes-axis" in (folder / "campaign.toml").read_text(encoding="utf-8") else "campaign"
        shutil.copytree(folder, base / f"{kind}{number}", ignore=shutil.ignore_patterns("results"))
    for words in ("mixed.csv trial --aperture", "grid.csv night --aperture"):
        _answer(f"simulate rig/rig.toml rig/{words} --seed 7", base, before)
    _answer("acquire rig/rig.toml rig/planned.csv run --simulate --centroids --seed 3", base, before)
    journal = (base / "run" / "log.jsonl").read_bytes().splitlines(keepends=True)
    (base / "run" / "log.jsonl").write_bytes(b"".join(journal[: len(journal) // 2]))


def _state(path: Path) -> None:
    """Take out of a file's model what only 0.3.0 has."""
    text = path.read_text(encoding="utf-8")
    table = "axis" if "tvsbayes-axis" in text else "rig.prior"
    lines = "".join(f"{name} = {{ value = 0.0, u = 0.0 }}\n" for name in TAKEN_OUT[table])
    text += "" if f"\n[{table}]" in text else f"\n[{table}]\n"
    path.write_text(re.sub(rf"^\[{re.escape(table)}\].*\n", rf"\g<0>{lines}", text, flags=re.M), encoding="utf-8")


def run(arguments: argparse.Namespace) -> None:
    """Run both releases."""
    PLACE.mkdir(parents=True, exist_ok=True)
    with tree_before(PLACE / "before") as before:
        if not (base := PLACE / "files").exists():
            _files(base, before, arguments.own)
        fitted = ["paper", "grid", *sorted(path.name for path in base.glob("[ac]*[0-9]"))]
        commands = {line.format(name): FRESH for name in fitted for line in FITS} | COMMANDS
        commands |= {f"report {name}": EVERY for name in fitted if name.startswith("axis")}
        for name in (NAME_BEFORE, *ASKED):
            folder, answers = PLACE / f"in {name}", PLACE / name
            if not folder.exists():
                shutil.copytree(PLACE / f"in {NAME_BEFORE}" if name == "reads" else base, folder)
                for path in (*folder.glob("*/campaign.toml"), folder / "rig/rig.toml") if name == "alike" else ():
                    _state(path)
            answers.mkdir(exist_ok=True)
            for number, (line, of) in enumerate(commands.items()):
                if name in (NAME_BEFORE, *of) and not (path := answers / f"{number:02d}.json").exists():
                    answer = _answer(line, folder, before if name == NAME_BEFORE else ROOT)
                    path.write_text(json.dumps({"asked": line, "commit": commit(), **answer}))
                    print(name, "|", line, "|", answer["code"], flush=True)


def _flat(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Objects and values by path."""
    yield path, node
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _flat(value, f"{path}.{key}" if path else key)
    elif isinstance(node, list):
        for place, value in enumerate(node):
            names = [str(value[key]) for key in NAMES if key in value] if isinstance(value, dict) else []
            yield from _flat(value, f"{path}[{' '.join(names) or place}]")


def _is_estimate(node: Any) -> bool:
    return isinstance(node, dict) and isinstance(node.get("value"), float) and bool(node.get("sd"))


def _monte_carlo(node: dict) -> float:
    """Variance of an estimate's value among repeated samplings; 0 where it is not sampled."""
    return node["sd"] ** 2 / node["ess_bulk"] if node.get("ess_bulk") else 0.0


def _says_the_same(before: list[str], after: list[str]) -> bool:
    """Do a row's numbers agree to the digits of the one with fewer?"""
    pairs = [(Decimal(a), Decimal(b)) for a, b in zip(before, after, strict=False)]
    digits = [Decimal(1).scaleb(max(int(value.as_tuple().exponent) for value in pair)) for pair in pairs]
    return len(before) <= len(after) and all(abs(a - b) <= d for (a, b), d in zip(pairs, digits, strict=True))


def _tables(before: dict, after: dict) -> str:
    """How many rows of a page's tables are found again, by their numbers: labels have become words."""
    rows, others = ([row for of in page.values() for row in of] for page in (before, after))
    same = sum(any(_says_the_same(row, other) for other in others) for row in rows)
    return f"{same} of {len(rows)} rows of its tables say the same"


def _largest(of: dict[str, float], form: str) -> str:
    """The largest one and where it stands."""
    path, value = max(of.items(), key=lambda item: item[1], default=("", 0.0))
    return f"{value:{form}} {path.removeprefix('printed').lstrip('.')}" if value else ""


def _cells(before: dict, after: dict) -> list[str]:
    """How many numbers are equal, largest differences, what else differs."""
    one, two = (
        dict(_flat({key: of[key] for key in of if key not in ("asked", "commit", "warned")})) for of in (before, after)
    )
    both = [path for path in one if path in two]
    counted = [path for path in both if {type(one[path]), type(two[path])} <= {int, float}]
    off = {p: abs(two[p] - one[p]) / max(abs(one[p]), abs(two[p])) for p in counted if one[p] != two[p]}
    pairs = {path: (one[path], two[path]) for path in both if _is_estimate(one[path]) and _is_estimate(two[path])}
    gaps = {path: abs(b["value"] - a["value"]) for path, (a, b) in pairs.items()}
    errors = {path: math.sqrt(_monte_carlo(a) + _monte_carlo(b)) for path, (a, b) in pairs.items()}
    widths = [b["sd"] / a["sd"] for path, (a, b) in pairs.items() if re.search(HEADLINE, path)]
    changed = [path for path in both if path.rpartition(".")[2] in SAID and one[path] != two[path]]
    keys = [{re.sub(r"\[.*?\]", "[]", path) for path in of if not re.search(FREE, path)} for of in (one, two)]
    others = [f"{p.rpartition('.')[2]}: {one[p]}, now {two[p]}" for p in changed]
    others += [f"no {key}" for key in sorted(keys[0] - keys[1])]
    page = "report.html"
    return [
        f"{len(counted) - len(off)} of {len(counted)}",
        _largest({path: share for path, share in off.items() if not re.search(NOISE, path)}, ".1e"),
        _largest({path: gap / pairs[path][0]["sd"] for path, gap in gaps.items()}, ".2g"),
        _largest({path: gap / errors[path] for path, gap in gaps.items() if errors[path]}, ".1f"),
        f"{min(widths):.2f} to {max(widths):.2f}" if widths else "",
        "; ".join([*others, *([_tables(before[page], after[page])] if page in before else [])]),
    ]


def table(_: argparse.Namespace) -> None:
    """The page."""
    names = (NAME_BEFORE, *ASKED)
    answers = {
        (name, path.name): json.loads(path.read_text()) for name in names for path in (PLACE / name).glob("*.json")
    }
    print(HEADER.format(before=NAME_BEFORE, commits=", ".join(sorted({of["commit"] for of in answers.values()}))))
    for name, heading in ASKED.items():
        print(f"\n## {heading}\n\n| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|")
        for (command, file), after in sorted(answers.items()):
            if command == name:
                cells = _cells(answers[NAME_BEFORE, file], after)
                moved = cells[1] or re.search(r"\b(?!(\d+) of \1 )\d+ of \d+ rows", cells[-1])
                why = next(why for how, what, why in CAUSES if how == name and re.search(what, after["asked"]))
                print(f"| `{after['asked']}` | {' | '.join(cells)} | {why if moved else 'bit-equal'} |")


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("own", type=Path, nargs="*", metavar="FOLDER", help="a campaign or axis folder")
    act(cli)
