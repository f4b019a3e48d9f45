"""What does `import` make of tables as strangers have them: right, asked, refused, or wrong in silence?

    python -m experiments.inputs.strangers_tables --n 2000 > experiments/inputs/strangers_tables/README.md
    python -m experiments.inputs.strangers_tables --seed 17 --show        # one table, its truth, what became of it
    python -m experiments.inputs.strangers_tables --seed 17 --write DIR   # the file alone

Table i is drawn by `numpy.random.default_rng(i)`: kind, language, names, units, layout, separators, encoding, further
columns. Its truth is what was read of an axis or a head, in which order, from which side, in which unit and with which
u. `import FILE --axis --to OUT --yes` (`--sightings` for a head) runs without a further option, and the folder must
hold the truth to the last digit written. Where `import` asks instead (exit 2), the command lines that its question
prints are run, and one of them must give the right folder. Files that are wrong in silence go to `experiments/output`.
"""

from __future__ import annotations

import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from experiments.common.command_line import parser
from experiments.common.page import share, table
from experiments.common.rows import ROOT
from experiments.inputs.strangers_tables import kinds, logs, reports, runs, sheets
from experiments.inputs.strangers_tables.judge import Verdict, judge
from experiments.inputs.strangers_tables.kinds import Drawn
from experiments.inputs.strangers_tables.measured import LANGUAGES, Stranger

OUTPUT = ROOT / "experiments" / "output" / "strangers_tables"
DRAWS = {
    **{kinds.long_table: 38, kinds.unit_row: 6, kinds.two_sensors: 4, kinds.unknown_unit: 2, kinds.no_unit: 2},
    **{runs.runs_with_words: 18, runs.grouped_runs: 6, runs.turning_runs: 1.5, runs.runs_without_words: 3},
    **{runs.runs_to_and_fro: 2, runs.deviations: 6, runs.averages: 4, runs.compensated: 3, runs.sorted_by_position: 2},
    **{logs.telemetry: 3, logs.labview: 4, logs.remark_names: 6, logs.serial: 6, logs.camonitor: 2, logs.sightings: 8},
    **{reports.tolerances: 5, reports.wrapped: 2, reports.sheet_with_means: 2, reports.blocks: 1.5},
    **dict.fromkeys((reports.positions_across, reports.two_axes, reports.numbered_sensors, reports.repeats), 1),
    **dict.fromkeys((kinds.reading_without_unit, kinds.unit_above), 1.5),
    **dict.fromkeys((reports.steps_and_target, reports.json_lines, reports.piezo), 1),
}
"""Weights of the kinds."""
WORDS = ("right", "guessed", "asked", "unanswered", "refused", "crash", "wrong")

EXPLAINED = (
    "A careful reader reads a table (*right*), may ask where the order of runs, the unit or a further column that\n"
    "follows the commands leaves it open (*either*), or has to (*ask*). *guessed*: right by luck, where it had to\n"
    "ask; *unanswered*: no command that the question prints gives the right folder; *refused*: it prints none."
)


def drawn_table(seed: int) -> Drawn:
    rng = np.random.default_rng(seed)
    weights = np.array(list(DRAWS.values()), float)
    draw = list(DRAWS)[int(rng.choice(len(DRAWS), p=weights / weights.sum()))]
    return draw(Stranger(rng, LANGUAGES[int(rng.integers(len(LANGUAGES)))]))


def judged(seed: int) -> tuple[Drawn, Verdict]:
    """A table, and what became of it."""
    drawn = drawn_table(seed)
    with tempfile.TemporaryDirectory() as folder:
        return drawn, judge(drawn, Path(folder))


def show(seed: int) -> None:
    """Print a table, the truth and the verdict."""
    drawn, verdict = judged(seed)
    print(f"{seed}: {drawn.kind}; {drawn.file.name}; {' '.join(drawn.words)}")
    print("\n".join(sheets.lines_of(drawn.file)[:30]))
    truth = drawn.truth
    print(f"truth: {len(truth.readings)} readings in {truth.unit}, commands in {truth.command_unit}: {truth.answer}")
    print(*truth.readings[:4], sep="\n")
    print(verdict)


class Tally:
    """What became of many tables."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
        self.reasons: dict[tuple[str, str], list[int]] = defaultdict(list)
        self.questions: Counter[tuple[str, str]] = Counter()
        self.unlisted: list[int] = []

    def add(self, seed: int, drawn: Drawn, verdict: Verdict) -> None:
        """Count a table; keep the file of one that is wrong in silence."""
        self.counts[drawn.kind, drawn.truth.answer][verdict.word] += 1
        if verdict.word in ("wrong", "crash"):
            self.reasons[f"{verdict.word}: {verdict.why}", drawn.kind].append(seed)
            OUTPUT.mkdir(parents=True, exist_ok=True)
            (OUTPUT / f"{seed}-{drawn.file.name.replace('.md', '.txt')}").write_bytes(drawn.file.data)
        elif verdict.question:
            self.questions[verdict.question, drawn.kind] += 1
        if verdict.unlisted:
            self.unlisted.append(seed)

    def of(self, *answers: str) -> Counter[str]:
        """Counts of the tables whose careful answer is one of these."""
        return sum((c for (_, answer), c in self.counts.items() if answer in answers), Counter())

    def page(self) -> None:
        """Print it."""
        every, clear = self.of("right", "either", "ask"), self.of("right")
        print("# Tables of strangers\n\n`python -m experiments.inputs.strangers_tables`\n")
        found = every["asked"] + every["right"] + every["guessed"]
        print(
            f"{every.total()} drawn tables: {every['wrong']} wrong in silence. Of {clear.total()} that state reading, "
            f"unit and order {share(clear['right'], clear.total())} are right without an option. {found} are right at "
            f"once, or by a command that the question prints.\n\n{EXPLAINED}\n"
        )
        rows = [(k, a, c.total(), *(c[word] or "" for word in WORDS)) for (k, a), c in sorted(self.counts.items())]
        print(table(("kind", "careful", "drawn", *WORDS), rows))
        if self.unlisted:
            numbers = " ".join(map(str, self.unlisted[:12]))
            print(f"\n{len(self.unlisted)} tables have columns that no line of `import` names: {numbers}.")
        if self.questions:
            print("\n## What was asked\n")
            print(table(("question", "kind", "tables"), [(*key, n) for key, n in self.questions.most_common()]))
        if self.reasons:
            print("\n## What was wrong\n")
            rows = [(*key, len(s), " ".join(map(str, s[:8]))) for key, s in sorted(self.reasons.items())]
            print(table(("reason", "kind", "tables", "numbers"), rows))


def main() -> None:
    """Read the command line, and carry it out."""
    cli = parser(__doc__)
    cli.add_argument("--n", type=int, default=2000, help="how many tables (%(default)s)")
    cli.add_argument("--first", type=int, default=0, help="number of the first (%(default)s)")
    cli.add_argument("--seed", type=int, help="this table alone")
    cli.add_argument("--show", action="store_true", help="print it, with its truth (what --seed does anyway)")
    cli.add_argument("--write", type=Path, metavar="DIR", help="write the file of --seed into a folder")
    arguments = cli.parse_args()
    if arguments.seed is None:
        tally = Tally()
        for seed in range(arguments.first, arguments.first + arguments.n):
            tally.add(seed, *judged(seed))
        tally.page()
    elif arguments.write:
        file = drawn_table(arguments.seed).file
        arguments.write.mkdir(parents=True, exist_ok=True)
        (arguments.write / file.name).write_bytes(file.data)
    else:
        show(arguments.seed)


if __name__ == "__main__":
    main()
