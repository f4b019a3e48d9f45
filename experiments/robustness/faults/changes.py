"""Changes of behaviour: what a bug does to a definition, planted in its syntax tree and found by names alone.

A place is the qualified name of a function, class or constant of the package, as short as it is unique: moving or
renaming a module leaves it. Inside it a change goes by the names of arguments, variables and called functions. The
expressions given here are Python; `value` stands for what was there.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple


class NoPlace(LookupError):
    """A name that stands for no definition or for several, or a change that finds nothing in its definition."""


class Definition(NamedTuple):
    """A function, class or constant: its module, the statement, the list that holds it, its name from the package."""

    path: Path
    tree: ast.Module
    node: ast.stmt
    body: list[ast.stmt]
    name: str


def _definitions(path: Path, prefix: str) -> Iterator[Definition]:
    """All of a module, in its order."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left = [(tree.body, prefix)]
    while left:
        body, prefix = left.pop(0)
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                yield Definition(path, tree, node, body, f"{prefix}.{node.name}")
                left.append((node.body, f"{prefix}.{node.name}"))
            else:
                targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
                for part in (part for target in targets if target for part in ast.walk(target)):
                    if isinstance(part, ast.Name):
                        yield Definition(path, tree, node, body, f"{prefix}.{part.id}")


class Sources:
    """The package in a tree: where its names stand."""

    def __init__(self, root: Path):
        package = root / "tvsbayes"
        self._prefixes = {
            path: ".".join(path.relative_to(root).with_suffix("").parts) for path in package.rglob("*.py")
        }
        self._modules = {
            one.name: path for path, prefix in self._prefixes.items() for one in _definitions(path, prefix)
        }
        self.firmware = sorted(path for path in package.rglob("*") if path.suffix in (".cpp", ".ino"))

    def definition(self, name: str) -> Definition:
        """The one definition that a name stands for, in a tree of its own; of overloads the last.

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
    """What becomes of a definition: of what goes by a name, and an expression; either may be missing."""

    def __init__(self, *arguments: str):
        self.arguments, self.count = arguments, 0
        self.name, self.expression = arguments[0], arguments[-1]

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
        self.generic_visit(place.node)

    def changed[Node](self, node: Node) -> Node:
        """Count a place."""
        self.count += 1
        return node

    def assigned(self, name: str) -> ast.stmt:
        """Another value for a name that has one."""
        value = _with(self.expression, value=_expression(name))
        return self.changed(ast.parse(f"{name} = {ast.unparse(value)}").body[0])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(map(repr, self.arguments))})"


class Constant(Change):
    """A constant of a module or class, or a field's default, has another value: another assignment follows it."""

    def change(self, place: Definition) -> None:
        if isinstance(place.node, ast.Assign | ast.AnnAssign):
            new = self.assigned(place.name.rpartition(".")[2])
            place.body.insert(place.body.index(place.node) + 1, new)


class Argument(Change):
    """A function takes one of its arguments for something else: its body begins with an assignment."""

    def change(self, place: Definition) -> None:
        node = place.node
        if isinstance(node, ast.FunctionDef) and self.name in {
            arg.arg for arg in ast.walk(node.args) if isinstance(arg, ast.arg)
        }:
            node.body.insert(int(ast.get_docstring(node) is not None), self.assigned(self.name))


class Returns(Change):
    """A function returns something else: an expression of `value`, its arguments and its variables."""

    def _itself(self, node: ast.AST) -> ast.AST:
        """Functions inside return to this one."""
        return node

    visit_FunctionDef = visit_Lambda = _itself

    def visit_Return(self, node: ast.Return) -> ast.stmt:
        if node.value is None:
            return node
        return self.changed(ast.Return(_with(self.expression, value=node.value)))


class Local(Change):
    """A variable or attribute has another value wherever it is assigned in a definition."""

    def _follow(self, node: ast.Assign | ast.AugAssign | ast.AnnAssign) -> ast.stmt | list[ast.stmt]:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        assigns = self.name in {ast.unparse(part) for target in targets for part in ast.walk(target)}
        return [node, self.assigned(self.name)] if assigns else node

    visit_Assign = visit_AugAssign = visit_AnnAssign = _follow


class Reads(Change):
    """A variable, attribute or element is taken for something else wherever a definition reads it."""

    def _read(self, node: ast.Name | ast.Attribute | ast.Subscript) -> ast.expr:
        if isinstance(node.ctx, ast.Load) and ast.unparse(node) == self.name:
            return self.changed(_with(self.expression, value=node))
        return self.generic_visit(node)

    visit_Name = visit_Attribute = visit_Subscript = _read


class Call(Change):
    """The call of a function becomes another expression: of `value`, the call itself, `function`, `arg0`, `arg1`."""

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        if _last_name(node.func) != self.name:
            return node
        arguments = {f"arg{k}": argument for k, argument in enumerate(node.args)}
        return self.changed(_with(self.expression, value=node, function=node.func, **arguments))


class Keyword(Change):
    """What is handed on under a name is something else."""

    def visit_keyword(self, node: ast.keyword) -> ast.keyword:
        self.generic_visit(node)
        if node.arg != self.name:
            return node
        return self.changed(ast.keyword(node.arg, _with(self.expression, value=node.value)))


class Never(Change):
    """A condition that a name takes part in is never met: a check that is left out."""

    def _decided[Node: (ast.If, ast.IfExp, ast.While, ast.comprehension)](self, node: Node) -> Node:
        self.generic_visit(node)
        loop = isinstance(node, ast.comprehension)
        parts = [part for test in (node.ifs if loop else [node.test]) for part in ast.walk(test)]
        if self.name in {_last_name(part) for part in parts if isinstance(part, ast.Name | ast.Attribute)}:
            self.changed(node)
            setattr(node, "ifs" if loop else "test", [_expression("False")] if loop else _expression("False"))
        return node

    visit_If = visit_IfExp = visit_While = visit_comprehension = _decided


class Uncalled(Change):
    """A function of the firmware, in C++, no longer calls another."""

    def planted(self, sources: Sources, name: str) -> tuple[Path, str]:
        """The file of a function, and its text without the calls.

        Raises:
            NoPlace: there is no such function, or it does not call the other.
        """
        whole = re.compile(rf"^\w[\w:*& ]* {re.escape(name)}\([^;]*?\) {{\n.*?^}}", re.MULTILINE | re.DOTALL)
        for path in sources.firmware:
            text = path.read_text(encoding="utf-8")
            for match in whole.finditer(text):
                call = rf"^\s*{re.escape(self.name)}\([^;]*\);\n"
                body, count = re.subn(call, "", match[0], flags=re.MULTILINE)
                if count:
                    return path, text[: match.start()] + body + text[match.end() :]
        raise NoPlace(f"no function {name} of the firmware calls {self.name}")
