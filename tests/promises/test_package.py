"""Wheel and source distribution of this tree: contents, and access to shipped files after installation."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
VERSION = PROJECT["project"]["version"]
SIZES_MAX = {".whl": 2_300_000, ".gz": 4_000_000}
"""Bytes: a few percent more than they take, so that pictures or results that slip in are seen."""
SHIPPED = (
    *("rigs/mounted/rig.toml", "rigs/nominal/rig.toml", "twins/paper_twin/spots.csv", "twins/grid_twin/truth.json"),
    *("schemas/fit-1.schema.json", "report/report.html", "report/report.css", "templates/campaign.toml"),
    *("export/tvs_calibration.h", "reference/table1.csv", "tutorial/rig.svg", "tutorial/README.md", "view/page.html"),
    *(path.relative_to(ROOT / "data").as_posix() for path in sorted((ROOT / "data" / "docs").glob("*.md"))),
)

pytestmark = pytest.mark.slow


def run(*command: object, **options: object) -> str:
    """Standard output of a command that must succeed."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=1200, **options)
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def environment(folder: Path) -> Path:
    """A fresh virtual environment; its interpreter."""
    run(sys.executable, "-m", "venv", folder)
    return folder / ("Scripts" if os.name == "nt" else "bin") / Path(sys.executable).name


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """Wheel and source distribution of the tree, and a wheel made from the latter, in a fresh environment."""
    folder = tmp_path_factory.mktemp("package")
    python = environment(folder / "builder")
    backend = PROJECT["build-system"]["requires"]
    install = subprocess.run(
        [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *backend], capture_output=True
    )
    if install.returncode:
        pytest.skip(f"no package index gives {', '.join(backend)}")
    run(python, "-m", "hatchling", "build", "-d", folder / "dist", cwd=ROOT)
    archives = {path.suffix: path for path in (folder / "dist").iterdir()}
    assert set(archives) == {".whl", ".gz"}
    from_source = folder / "again"
    pip = (python, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
    run(*pip, "-w", from_source, archives[".gz"], cwd=folder)
    return {**archives, "again": next(from_source.glob("*.whl"))}


def test_distributions_have_the_expected_contents(built):
    assert built[".whl"].name == f"tvsbayes-{VERSION}-py3-none-any.whl"
    assert built[".gz"].name == f"tvsbayes-{VERSION}.tar.gz"
    for kind, limit in SIZES_MAX.items():
        assert built[kind].stat().st_size < limit
    wheel, again = (sorted(zipfile.ZipFile(built[kind]).namelist()) for kind in (".whl", "again"))
    assert wheel == again
    assert {name.split("/")[0] for name in wheel} == {"tvsbayes", f"tvsbayes-{VERSION}.dist-info"}
    packages = {path.parent.name for path in (ROOT / "tvsbayes").glob("*/__init__.py")}
    assert {name.split("/")[1] for name in wheel if name.count("/") > 1 and "dist-info" not in name} == {
        "data",
        *packages,
    }
    kept = {f"tvsbayes/data/{name}" for name in SHIPPED}
    flashed = ("tvs_positioner.ino", "tvs_core.h", "tvs_core.cpp", "tvs_motion.cpp")
    kept |= {f"tvsbayes/positioner/firmware/tvs_positioner/{name}" for name in flashed}
    kept |= {f"tvsbayes/positioner/firmware/{name}" for name in ("README.md", "native/replay.cpp")}
    assert kept <= set(wheel)
    with tarfile.open(built[".gz"]) as archive:
        source = [name.partition("/")[2] for name in archive.getnames()]
    stray = ("experiments/output", "results/", ".venv", "__pycache__", ".git/")
    # A package of that name, and files of an older version; other results of campaigns stay out.
    packaged = ("tvsbayes/results/", "tests/results/", "tests/data/of-0.1.0/", "tests/data/foreign/kalibr_results/")
    others = [name for name in (*wheel, *source) if not name.startswith(packaged)]
    assert not [name for name in others if any(part in name for part in stray)]
    modules = {
        f"tvsbayes/{path.relative_to(ROOT / 'tvsbayes').as_posix()}" for path in (ROOT / "tvsbayes").rglob("*.py")
    }
    assert modules <= set(wheel)
    assert {
        *("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "experiments/README.md"),
        *("tests/promises/test_package.py", "data/docs/formulation.md", "data/docs/site/mkdocs.yml"),
    } <= set(source)


@pytest.mark.parametrize("kind", [".whl", "again"])
def test_installed_package_works_away_from_the_tree(kind, built, tmp_path):
    """Dependencies are this interpreter's, by a path file; the package itself is the installed one."""
    python = environment(tmp_path / "venv")
    run(python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", built[kind])
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    command = python.parent / "tvsbayes"
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    options = {"cwd": tmp_path, "env": {**clean, "TVSBAYES_CACHE": str(tmp_path / "cache")}}
    where = Path(run(python, "-c", "import tvsbayes; print(tvsbayes.__file__)", **options).strip())
    assert where.is_relative_to(tmp_path)
    assert run(python, "-c", "import tvsbayes; print(tvsbayes.__version__)", **options).strip() == VERSION
    assert "Commands" in run(command, "--help", **options)
    run(command, "new", "x", **options)
    assert {path.name for path in (tmp_path / "x").iterdir()} == {"campaign.toml", "moves.csv", "rig.toml", "spots.csv"}
    data = Path(
        run(python, "-c", "from tvsbayes.files.disk import shipped_data; print(shipped_data())", **options).strip()
    )
    assert data.is_relative_to(tmp_path)
    assert [name for name in SHIPPED if not (data / name).is_file()] == []
    shown = "from tvsbayes.positioner import firmware_folder; print(firmware_folder())"
    assert (Path(run(python, "-c", shown, **options).strip()) / "README.md").is_file()
    # The words of tables are data of the package.
    (tmp_path / "messuhr.csv").write_text("Sollposition (mm);Messuhr (1/100 mm)\n0;0,2\n10;1000,5\n20;2001,0\n0;3,1\n")
    run(command, "import", "messuhr.csv", "--axis", "--to", "screw", "--yes", **options)
    assert 'unit = "mm"' in (tmp_path / "screw" / "campaign.toml").read_text(encoding="utf-8")
    if kind == ".whl":  # the same files as from source: one fit is enough
        document = json.loads(run(command, "demo", "--json", **options))
        assert document["fit"]["converged"] is True
