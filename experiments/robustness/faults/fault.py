"""What a planted fault is: a line that is changed, what a user would suffer, which tests are likely to see it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """A bug of one line.

    Attributes:
        name: unique, in words.
        file: in `tvsbayes/`.
        old: text that stands in the file exactly once.
        new: what it becomes.
        harm: what a user would suffer.
        tests: the test files (or single tests) most likely to see it, as "package/module" or "package/module::test":
            they are run first, and what gets past them meets the other tests as well.
        survived: why no default test saw it before one was written for it, seen in a run or read off the tests; empty
            for the others.
    """

    name: str
    file: str
    old: str
    new: str
    harm: str
    tests: tuple[str, ...]
    survived: str = ""

    @property
    def path(self) -> str:
        """Relative to the root."""
        return f"tvsbayes/{self.file}"

    @property
    def package(self) -> str:
        """Of `tvsbayes/`; a single module's own name."""
        return self.file.partition("/")[0].removesuffix(".py")

    @property
    def selection(self) -> tuple[str, ...]:
        """Arguments of pytest."""
        found = []
        for one in self.tests:
            file, _, single = one.partition("::")
            package, _, module = file.partition("/")
            found.append(f"tests/{package}/test_{module}.py" + (f"::{single}" if single else ""))
        return tuple(found)
