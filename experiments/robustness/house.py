"""How large are the rooms of the package, and what makes them large? The table of rooms in data/docs/architecture.md.

    python -m experiments.robustness.house [FOLDER ...]       # tvsbayes, tests and experiments where none is named

Lines are split into code, imports, docstrings, and blank lines with comments. A public name with one reference is a
function or class at the top of a module whose name is read once in all Python of the repository. A bag is a dataclass
or named tuple without a method that is built in one place. A name defined twice is that of functions or classes at
the top of two modules of the package.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections import Counter
from pathlib import Path

from experiments.common.command_line import parser
from experiments.common.page import heading, line
from experiments.common.rows import ROOT

FOLDERS = ("tvsbayes", "tests", "experiments")
TITLES = "modules | lines | code | imports | docstrings | blank, comments | one reference | bags | defined twice"
NOTHING = (
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING),
    tokenize.ENDMARKER,
)
BAGS = ("dataclass", "NamedTuple", "Struct")


def modules_of(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*.py")) if "output" not in path.relative_to(ROOT).parts]


def split(text: str, tree: ast.Module) -> Counter[str]:
    """Lines by what they hold; a line belongs to the first of these."""
    imports, prose = set(), set()
    for node in ast.walk(tree):
        lines = range(getattr(node, "lineno", 0), getattr(node, "end_lineno", -1) + 1)
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports |= {*lines}
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            prose |= {*lines}
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = {n for t in tokens if t.type not in NOTHING for n in range(t.start[0], t.end[0] + 1)} - imports - prose
    whole = len(text.splitlines())
    counts = {"lines": whole, "code": len(code), "imports": len(imports), "docstrings": len(prose)}
    return Counter(counts | {"blank": whole - len(code | imports | prose), "modules": 1})


def is_bag(node: ast.stmt) -> bool:
    """A class that holds fields and has no method."""
    if not isinstance(node, ast.ClassDef) or any(isinstance(part, ast.FunctionDef) for part in node.body):
        return False
    heads = " ".join(map(ast.unparse, [*node.decorator_list, *node.bases]))
    return any(word in heads for word in BAGS)


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("folders", nargs="*", default=list(FOLDERS), help="relative to the repository's root")
    arguments: argparse.Namespace = cli.parse_args()
    texts = {path: path.read_text(encoding="utf-8") for name in FOLDERS for path in modules_of(ROOT / name)}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    uses = Counter(node.id for node in nodes if isinstance(node, ast.Name))
    uses.update(node.attr for node in nodes if isinstance(node, ast.Attribute))
    calls = Counter(name for text in texts.values() for name in re.findall(r"\b(\w+)\(", text))
    tops = {
        path: [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        for path, tree in trees.items()
    }
    package = ROOT / "tvsbayes"
    defined = Counter(node.name for path, nodes in tops.items() if package in path.parents for node in nodes)
    for folder in map(ROOT.joinpath, arguments.folders):
        rooms: dict[str, Counter[str]] = {}
        for path in modules_of(folder):
            parts = path.relative_to(folder).parts
            counts = rooms.setdefault(parts[0] if len(parts) > 1 else "(modules beside)", Counter())
            counts.update(split(texts[path], trees[path]))
            public = [node for node in tops[path] if not node.name.startswith("_")]
            counts["once"] += sum(uses[node.name] == 1 for node in public)
            counts["bags"] += sum(is_bag(node) and calls[node.name] <= 1 for node in tops[path])
            counts["twice"] += sum(defined[node.name] > 1 for node in tops[path] if package in path.parents)
        print(f"\n{heading(folder.name, TITLES)}")
        keys = ("modules", "lines", "code", "imports", "docstrings", "blank", "once", "bags", "twice")
        for room, counts in [*sorted(rooms.items()), ("**all**", sum(rooms.values(), Counter()))]:
            print(line(room, *(counts[key] for key in keys)))


if __name__ == "__main__":
    main()
