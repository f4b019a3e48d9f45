"""What does `import` make of tables as strangers have them: right, asked, refused, or wrong in silence?

    python -m experiments.inputs.strangers_tables --n 2000 > experiments/inputs/strangers_tables/README.md
    python -m experiments.inputs.strangers_tables --seed 17        # one table, its truth, what became of it

Table i is drawn by `numpy.random.default_rng(i)`: kind, language, names, units, layout, separators, encoding, further
columns. Its truth is what was read of an axis, in which order, from which side, in which unit and with which u.
`import FILE --axis --to OUT --yes` runs without a further option, and the folder must hold the truth to the last digit
written. Where `import` asks instead (exit 2), the command lines that its question prints are run, and one of them must
give the right folder. Files that are wrong in silence go to `experiments/output`.
"""

from __future__ import annotations

import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from experiments.common.command_line import parser
from experiments.common.page import share, table
from experiments.common.rows import ROOT
from experiments.inputs.strangers_tables.judge import Verdict, judge
from experiments.inputs.strangers_tables.kinds import DRAWS, Drawn
from experiments.inputs.strangers_tables.measured import LANGUAGES, Stranger

OUTPUT = ROOT / "experiments" / "output" / "strangers_tables"
WORDS = ("right", "guessed", "asked", "unanswered", "refused", "crash", "wrong")
EXPLAINED = """
A careful reader reads a table (*right*), may ask where the order of runs, the unit or a further column that
follows the commands leaves it open (*either*), or has to (*ask*). *guessed*: right by luck, where it had to
ask; *unanswered*: no command that the question prints gives the right folder; *refused*: it prints none.
"""


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
    print(f"{seed}: {drawn.kind}; {drawn.file.name}", *drawn.file.lines()[:30], sep="\n")
    truth = drawn.truth
    print(f"truth: {len(truth.readings)} readings in {truth.unit}, commands in {truth.command_unit}: {truth.answer}")
    print(*truth.readings[:4], verdict, sep="\n")


def page(seeds: range) -> None:
    """Judge tables and print what became of them; files of those that are wrong are kept."""
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    reasons: dict[tuple[str, str], list[int]] = defaultdict(list)
    questions: Counter[tuple[str, str]] = Counter()
    for seed in seeds:
        drawn, verdict = judged(seed)
        counts[drawn.kind, drawn.truth.answer][verdict.word] += 1
        if verdict.word in ("wrong", "crash"):
            reasons[f"{verdict.word}: {verdict.why}", drawn.kind].append(seed)
            OUTPUT.mkdir(parents=True, exist_ok=True)
            (OUTPUT / f"{seed}-{drawn.file.name}").write_bytes(drawn.file.data)
        elif verdict.question:
            questions[verdict.question, drawn.kind] += 1
    every = sum(counts.values(), Counter())
    clear = sum((count for (_, answer), count in counts.items() if answer == "right"), Counter())
    print("# Tables of strangers\n\n`python -m experiments.inputs.strangers_tables`\n")
    found = every["right"] + every["guessed"] + every["asked"]
    print(
        f"{every.total()} drawn tables, {seeds[0]} to {seeds[-1]}: {every['wrong']} wrong in silence. Of "
        f"{clear.total()} that state reading, unit and order {share(clear['right'], clear.total())} are right without "
        f"an option. {found} are right at once, or by a command that the question prints.\n{EXPLAINED}"
    )
    rows = [(k, a, c.total(), *(c[word] or "" for word in WORDS)) for (k, a), c in sorted(counts.items())]
    print(table(("kind", "careful", "drawn", *WORDS), rows))
    print("\n## What was asked\n")
    print(table(("question", "kind", "tables"), [(*key, n) for key, n in questions.most_common()]))
    if reasons:
        print("\n## What was wrong\n")
        rows = [(*key, len(s), " ".join(map(str, s[:8]))) for key, s in sorted(reasons.items())]
        print(table(("reason", "kind", "tables", "numbers"), rows))


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("--n", type=int, default=2000, help="how many tables (%(default)s)")
    cli.add_argument("--first", type=int, default=0, help="number of the first (%(default)s)")
    cli.add_argument("--seed", type=int, help="this table alone")
    arguments = cli.parse_args()
    if arguments.seed is None:
        page(range(arguments.first, arguments.first + arguments.n))
    else:
        show(arguments.seed)


if __name__ == "__main__":
    main()
