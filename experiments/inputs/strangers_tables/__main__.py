"""What does `import` make of tables as strangers have them: right, asked, refused, or wrong in silence?

    python -m experiments.inputs.strangers_tables --n 2000 > experiments/inputs/strangers_tables/README.md
    python -m experiments.inputs.strangers_tables --seed 17 --show        # one table, its truth, what became of it

Table number i of 2000 is drawn by `numpy.random.default_rng(i)`: kind, language, names, units, layout, separators,
encoding, further columns; its truth is the axis, what was read of it, in which order, in which unit and with which u.
`import FILE --axis --to OUT --yes` (`--sightings` for a head) runs without a further option, and the folder must hold the
truth to the last digit written. Where `import` asks instead (exit 2), the command lines that its question prints are
run, and one of them must give the right folder. Tables that are wrong in silence go to `experiments/output`.
"""

from __future__ import annotations

import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from experiments.common.command_line import parser
from experiments.common.page import table
from experiments.common.rows import ROOT
from experiments.inputs.strangers_tables import kinds, logs, runs
from experiments.inputs.strangers_tables.judge import Verdict, judge
from experiments.inputs.strangers_tables.kinds import Drawn
from experiments.inputs.strangers_tables.measured import pick
from experiments.inputs.strangers_tables.words import LANGUAGES

OUTPUT = ROOT / "experiments" / "output" / "strangers_tables"
DRAWS = {
    **{kinds.long_table: 32, kinds.unit_row: 6, kinds.two_sensors: 4, kinds.unknown_unit: 2, kinds.no_unit: 2},
    **{runs.runs_with_words: 16, runs.grouped_runs: 5, runs.turning_runs: 2, runs.runs_without_words: 4},
    **{runs.runs_to_and_fro: 2, runs.deviations: 7, runs.averages: 4},
    **{logs.telemetry: 3, logs.labview: 4, logs.remark_names: 6, logs.serial: 6, logs.camonitor: 2, logs.sightings: 7},
}
"""Weights of the kinds."""
WORDS = ("right", "guessed", "asked", "unanswered", "refused", "crash", "wrong")


def drawn_table(seed: int) -> Drawn:
    """The table of a seed."""
    rng = np.random.default_rng(seed)
    weights = np.array(list(DRAWS.values()), float)
    draw = list(DRAWS)[int(rng.choice(len(DRAWS), p=weights / weights.sum()))]
    return draw(rng, pick(rng, LANGUAGES))


def judged(seed: int) -> tuple[Drawn, Verdict]:
    """A table, and what became of it."""
    drawn = drawn_table(seed)
    with tempfile.TemporaryDirectory() as folder:
        return drawn, judge(drawn, Path(folder))


def show(seed: int) -> None:
    """Print a table, the truth and the verdict."""
    drawn, verdict = judged(seed)
    print(f"{seed}: {drawn.kind}; {drawn.file.name}; {' '.join(drawn.words)}")
    data = drawn.file.data
    for encoding in ("utf-16" if data[:1] in b"\xff\xfe" else "utf-8-sig", "cp1252") if data[:2] != b"PK" else ():
        try:
            print("\n".join(data.decode(encoding).splitlines()[:30]))
            break
        except UnicodeError:
            continue
    else:
        import io

        import openpyxl

        for row in list(openpyxl.load_workbook(io.BytesIO(data)).active.values)[:30]:
            print(row)
    truth = drawn.truth
    print(f"truth: {len(truth.readings)} readings in {truth.unit}, commands in {truth.command_unit}, {truth.answer}")
    print(*truth.readings[:4], sep="\n")
    print(verdict)


def page(first: int, n: int) -> None:
    """Judge tables and print the page; those wrong in silence go to the folder of outputs."""
    counts: dict[tuple[str, str], Counter] = defaultdict(Counter)
    wrong: dict[tuple[str, str], list[int]] = defaultdict(list)
    questions: Counter = Counter()
    for seed in range(first, first + n):
        drawn, verdict = judged(seed)
        counts[drawn.kind, drawn.truth.answer][verdict.word] += 1
        if verdict.word in ("wrong", "crash", "unanswered", "refused"):
            wrong[verdict.word, f"{drawn.kind}: {verdict.why or verdict.question[:90]}"].append(seed)
        if verdict.word == "wrong":
            OUTPUT.mkdir(parents=True, exist_ok=True)
            (OUTPUT / f"{seed}-{drawn.file.name}").write_bytes(drawn.file.data)
        if verdict.question:
            questions[drawn.kind, verdict.question.split(":")[0], verdict.word] += 1
    rows = [
        (kind, answer, counts[kind, answer].total(), *(counts[kind, answer][w] or "" for w in WORDS))
        for kind, answer in sorted(counts)
    ]
    print("# Tables of strangers\n")
    print(table(("kind", "careful answer", "drawn", *WORDS), rows))
    clear = sum((c for (_, answer), c in counts.items() if answer == "right"), Counter())
    print(
        f"\nclear tables: {clear['right']} of {clear.total()} right without an option; {clear['wrong']} wrong in silence"
    )
    for (word, why), seeds in sorted(wrong.items(), key=lambda item: (item[0][0], -len(item[1]))):
        print(f"- {word}: {why}: {len(seeds)}: {' '.join(map(str, seeds[:12]))}")


if __name__ == "__main__":
    cli = parser(__doc__)
    cli.add_argument("--n", type=int, default=2000, help="how many tables (%(default)s)")
    cli.add_argument("--first", type=int, default=0, help="number of the first (%(default)s)")
    cli.add_argument("--seed", type=int, help="this table alone")
    cli.add_argument("--show", action="store_true", help="print it, with its truth")
    arguments = cli.parse_args()
    if arguments.seed is not None:
        show(arguments.seed)
    else:
        page(arguments.first, arguments.n)
