"""Changes of behaviour: what a bug does to a definition, planted in its syntax tree and found by names alone.

A place is the qualified name of a function, class or constant of the package, as short as it is unique: moving or
renaming a module leaves it. Inside it a change goes by the names of arguments, variables and called functions. The
expressions given here are Python; `value` stands for what was there.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


class NoPlace(LookupError):
    """A name that stands for no definition or for several, or a change that finds nothing in its definition."""


@dataclass(frozen=True)
class Definition:
    """A function, class or constant.

    Attributes:
        path: of its module.
        tree: of its module.
        node: of the definition, in the tree.
        body: the list of statements that holds the node.
        name: qualified, from the package on.
    """

    path: Path
    tree: ast.Module
    node: ast.stmt
    body: list[ast.stmt]
    name: str


def _names(statement: ast.stmt) -> list[str]:
    """What a statement defines."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [statement.name]
    targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
    return [node.id for target in targets if target for node in ast.walk(target) if isinstance(node, ast.Name)]


def _definitions(path: Path, prefix: str) -> list[Definition]:
    """All of a module; of overloads the last counts."""
    tree = ast.parse(path.read_text(encoding="utf-8"))

    def within(body: list[ast.stmt], prefix: str) -> Iterator[Definition]:
        for statement in body:
            for name in _names(statement):
                yield Definition(path, tree, statement, body, f"{prefix}.{name}")
            if isinstance(statement, ast.FunctionDef | ast.ClassDef):
                yield from within(statement.body, f"{prefix}.{statement.name}")

    return list(within(tree.body, prefix))


class Sources:
    """The package in a tree: where its names stand."""

    def __init__(self, root: Path):
        package = root / "tvsbayes"
        prefixes = {path: ".".join(path.relative_to(root).with_suffix("").parts) for path in package.rglob("*.py")}
        self._modules = {one.name: path for path, prefix in prefixes.items() for one in _definitions(path, prefix)}
        self._prefixes = prefixes
        self.firmware = sorted(path for path in package.rglob("*") if path.suffix in (".cpp", ".ino"))

    def definition(self, name: str) -> Definition:
        """The one definition that a name stands for, in a tree of its own.

        Raises:
            NoPlace: there is none, or there are several.
        """
        names = [whole for whole in self._modules if f".{whole}".endswith(f".{name}")]
        if len(names) != 1:
            raise NoPlace(f"{name} stands for {len(names)} definitions: {', '.join(names) or 'none'}")
        path = self._modules[names[0]]
        return [one for one in _definitions(path, self._prefixes[path]) if one.name == names[0]][-1]


def _expression(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


def _with(text: str, **values: ast.expr) -> ast.expr:
    """An expression in which names stand for other expressions."""

    class Replaced(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.expr:
            return values.get(node.id, node)

    return Replaced().visit(_expression(text))


def _last_name(node: ast.expr) -> str:
    return ast.unparse(node).rpartition(".")[2]


class Change(ast.NodeTransformer):
    """What becomes of a definition; counts the places that it has changed."""

    def __init__(self) -> None:
        self.count = 0

    def planted(self, sources: Sources, name: str) -> tuple[Path, str]:
        """The module of a definition, and its text with the change.

        Raises:
            NoPlace: the name stands for no definition or for several, or there is nothing to change in it.
        """
        place, self.count = sources.definition(name), 0
        self.change(place)
        if not self.count:
            raise NoPlace(f"{place.name} holds nothing for {self}")
        return place.path, ast.unparse(ast.fix_missing_locations(place.tree)) + "\n"

    def change(self, place: Definition) -> None:
        """Change what is inside."""
        self.generic_visit(place.node)

    def changed[Node](self, node: Node) -> Node:
        """Count a place."""
        self.count += 1
        return node

    def __repr__(self) -> str:
        arguments = (f"{value!r}" for name, value in vars(self).items() if name != "count")
        return f"{type(self).__name__}({', '.join(arguments)})"


class Named(Change):
    """A change of what goes by a name inside a definition."""

    def __init__(self, name: str, expression: str):
        super().__init__()
        self.name, self.expression = name, expression


class Constant(Change):
    """A constant of a module or class, or a field's default, has another value."""

    def __init__(self, expression: str):
        super().__init__()
        self.expression = expression

    def change(self, place: Definition) -> None:
        """Follow the definition with another."""
        name = place.name.rpartition(".")[2]
        new = ast.Assign([ast.Name(name, ast.Store())], _with(self.expression, value=ast.Name(name, ast.Load())))
        if isinstance(place.node, ast.Assign | ast.AnnAssign):
            place.body.insert(place.body.index(place.node) + 1, self.changed(new))


class Argument(Named):
    """A function takes one of its arguments for something else."""

    def change(self, place: Definition) -> None:
        """Begin the body with an assignment."""
        node = place.node
        if not isinstance(node, ast.FunctionDef):
            return
        if self.name in {arg.arg for arg in ast.walk(node.args) if isinstance(arg, ast.arg)}:
            value = _with(self.expression, value=ast.Name(self.name, ast.Load()))
            new = ast.Assign([ast.Name(self.name, ast.Store())], value)
            node.body.insert(int(ast.get_docstring(node) is not None), self.changed(new))


class Returns(Change):
    """A function returns something else: an expression of `value`, its arguments and its variables."""

    def __init__(self, expression: str):
        super().__init__()
        self.expression = expression

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.stmt:
        """Functions inside return to this one."""
        return node

    def visit_Lambda(self, node: ast.Lambda) -> ast.expr:
        """The same."""
        return node

    def visit_Return(self, node: ast.Return) -> ast.stmt:
        """Every end of the function."""
        if node.value is None:
            return node
        return self.changed(ast.Return(_with(self.expression, value=node.value)))


class Local(Named):
    """A variable or attribute has another value wherever it is assigned in a definition."""

    def _follow(self, node: ast.Assign | ast.AugAssign | ast.AnnAssign) -> ast.stmt | list[ast.stmt]:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if self.name not in {ast.unparse(part) for target in targets for part in ast.walk(target)}:
            return node
        value = _with(self.expression, value=_expression(self.name))
        return [node, self.changed(ast.parse(f"{self.name} = {ast.unparse(value)}").body[0])]

    visit_Assign = visit_AugAssign = visit_AnnAssign = _follow


class Reads(Named):
    """A variable, attribute or element is taken for something else wherever a definition reads it."""

    def _read(self, node: ast.Name | ast.Attribute | ast.Subscript) -> ast.expr:
        if isinstance(node.ctx, ast.Load) and ast.unparse(node) == self.name:
            return self.changed(_with(self.expression, value=node))
        return self.generic_visit(node)

    visit_Name = visit_Attribute = visit_Subscript = _read


class Call(Named):
    """The call of a function becomes another expression: of `value`, the call itself, `function`, `arg0`, `arg1`."""

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """Every call of that name."""
        self.generic_visit(node)
        if _last_name(node.func) != self.name:
            return node
        arguments = {f"arg{k}": argument for k, argument in enumerate(node.args)}
        return self.changed(_with(self.expression, value=node, function=node.func, **arguments))


class Keyword(Named):
    """What is handed on under a name is something else."""

    def visit_keyword(self, node: ast.keyword) -> ast.keyword:
        """Every argument of that name."""
        self.generic_visit(node)
        if node.arg != self.name:
            return node
        return self.changed(ast.keyword(node.arg, _with(self.expression, value=node.value)))


class Never(Change):
    """A condition that a name takes part in is never met: a check that is left out."""

    def __init__(self, name: str):
        super().__init__()
        self.name = name

    def _decided[Node: (ast.If, ast.IfExp, ast.While, ast.comprehension)](self, node: Node) -> Node:
        self.generic_visit(node)
        tests = node.ifs if isinstance(node, ast.comprehension) else [node.test]
        for test in tests:
            if self.name in {_last_name(part) for part in ast.walk(test) if isinstance(part, ast.Name | ast.Attribute)}:
                self.changed(node)
                if isinstance(node, ast.comprehension):
                    node.ifs = [_expression("False")]
                else:
                    node.test = _expression("False")
        return node

    visit_If = visit_IfExp = visit_While = visit_comprehension = _decided


class Uncalled:
    """A function of the firmware, in C++, no longer calls another."""

    def __init__(self, called: str):
        self.called = called

    def planted(self, sources: Sources, name: str) -> tuple[Path, str]:
        """The file of a function, and its text without the calls.

        Raises:
            NoPlace: there is no such function, or it does not call the other.
        """
        whole = re.compile(rf"^\w[\w:*& ]* {re.escape(name)}\([^;]*?\) {{\n.*?^}}", re.MULTILINE | re.DOTALL)
        for path in sources.firmware:
            text = path.read_text(encoding="utf-8")
            for match in whole.finditer(text):
                body, count = re.subn(rf"^\s*{re.escape(self.called)}\([^;]*\);\n", "", match[0], flags=re.MULTILINE)
                if count:
                    return path, text[: match.start()] + body + text[match.end() :]
        raise NoPlace(f"no function {name} of the firmware calls {self.called}")

    def __repr__(self) -> str:
        return f"Uncalled({self.called!r})"
