"""Checks of the README: size, set-up commands, printed answer, versions."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINES_MAX = 100


def test_first_screen_has_two_set_up_commands_and_the_printed_answer():
    commands = re.findall(r"```sh\n(.*?)\n```", README.split("\n## ")[0], flags=re.DOTALL)
    assert [command.count("\n") for command in commands] == [0, 0]
    assert all(command.startswith("python3 -m venv .venv && .venv/bin/pip install ") for command in commands)
    assert commands[0].endswith("tvsbayes demo")
    assert "-c .ci/constraints.txt" in commands[1]
    assert "joint  holds truth     truth" in README.split("\n## ")[0]
    # The first command installs the newest versions, not the pinned ones.
    assert "Last digits may differ with library versions." in README.split("\n## ")[0]


def test_readme_is_short_and_warns_of_the_laser():
    assert README.count("\n") <= LINES_MAX
    assert "808 nm laser is invisible and likely class 3B" in README


def test_constraints_pin_every_direct_dependency():
    """A dependency without a pin would be tested at a varying version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + extras["test"] + extras["docs"]
    names = [re.match(r"[\w-]+", requirement).group() for requirement in wanted]
    assert [name for name in names if name not in pins] == []


def test_version_is_one_and_the_same():
    """`pyproject.toml` has it; the changelog's newest release and the citation say the same version and day."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.search(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", changes, flags=re.MULTILINE)
    assert released and released[1] == version
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {version}\ndate-released: {released[2]}\n" in citation
