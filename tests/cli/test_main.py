"""Ways to end: errors, usage, interrupts, broken pipes, bugs; modules loaded by `--help`."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from support.commands import PAPER_TWIN, assert_error

from tvsbayes.cli.main import main, run
from tvsbayes.pipeline import SAMPLING
from tvsbayes.posterior.sampling import walking
from tvsbayes.progress import Progress
from tvsbayes.results.tiers import CHAIN

pytestmark = pytest.mark.usefixtures("own_compilation_cache")
MAIN = (sys.executable, "-c", "from tvsbayes.cli.main import main; main()")


@pytest.mark.parametrize("command", ["check", "classic", "fit"])
def test_hostile_files_are_input_errors(ask, say, grid_folder, command):
    """Refusals of readers: `promises/test_hostile.py`."""
    file = grid_folder / "campaign.toml"
    file.write_text("colour = 'red'\n" + file.read_text())
    code, document = ask(command, grid_folder)
    assert code == 2
    assert set(document) == {"error"}
    assert assert_error(document, "unknown-key")["file"] == "campaign.toml"
    code, out, log = say(command, grid_folder)
    assert (code, out) == (2, "")
    assert log.startswith("error: campaign.toml")
    assert "Traceback" not in log


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux")
@pytest.mark.parametrize("arguments", [("check", "FOLDER", "--json"), ("check", "nothing here", "--json")])
def test_a_full_disk_behind_stdout_gives_no_traceback(grid_folder, arguments):
    words = [str(grid_folder) if word == "FOLDER" else word for word in arguments]
    with open("/dev/full", "w") as full:
        done = subprocess.run([*MAIN, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2 and "No space left" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8"])
def test_names_that_stdout_cannot_show_are_escaped(tmp_path, encoding):
    """A Greek letter on a terminal of Western letters; bytes that are no UTF-8 stand for half a character."""
    name = "\u03ac" if encoding != "utf-8" or os.name != "posix" else os.fsdecode(b"caf\xe9")
    command = [*MAIN, "import", tmp_path / "log.csv", "--axis", "--to", tmp_path / name, "--yes"]
    (tmp_path / "log.csv").write_text("command,value\n0,0\n1,1\n")
    environment = {**os.environ, "PYTHONIOENCODING": f"{encoding}:strict", "PYTHONUTF8": "1"}
    done = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    escaped = b"\\udce9" if name.startswith("caf") else b"\\u03ac"
    written = done.stdout.split(b"written: ")[1]
    assert escaped in written or (encoding == "utf-8" and os.name != "posix")


@pytest.mark.skipif(os.name != "posix", reason="streams that a shell closes")
@pytest.mark.parametrize(("arguments", "code"), [("check nothing-here", 2), ("--version", 0)])
@pytest.mark.parametrize("closed", ["2>&-", ">&-"])
def test_closed_streams_change_no_exit_code(tmp_path, closed, arguments, code):
    """Cron jobs and services have closed streams."""
    words = f'"$0" -c "from tvsbayes.cli.main import main; main()" {arguments} {closed}'
    done = subprocess.run(["sh", "-c", words, sys.executable], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == code
    assert b"Traceback" not in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="pipes that break")
@pytest.mark.parametrize("arguments", [("check", "nothing here"), ("frobnicate",)])
def test_a_closed_pipe_changes_no_exit_code(monkeypatch, arguments):
    """As when Ctrl-C ends the `tee` behind a run; both streams."""
    # The rest of a buffer would fail again when Python exits: exit code 120.
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    command = [*MAIN, *arguments]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command, stdout=writer, stderr=writer, check=False)
    with_json = subprocess.run([*command, "--json"], stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, with_json.returncode, with_json.stderr) == (2, 2, "")


@pytest.fixture
def reading(monkeypatch):
    """What reading a campaign raises: `reading(error)`."""

    def fail(error: BaseException) -> None:
        def broken(path):
            raise error

        monkeypatch.setattr("tvsbayes.instrument.campaign.read_campaign", broken)
        monkeypatch.setattr("tvsbayes.acquisition.journal_check.read_campaign", broken)

    return fail


def test_an_interrupt_is_130_and_under_json_a_document(ask, say, reading):
    reading(KeyboardInterrupt())
    code, document = ask("check", "x")
    assert (code, document["error"]["code"]) == (130, "interrupted")
    code, out, log = say("classic", PAPER_TWIN)
    assert (code, out) == (130, "")
    assert "interrupted" in log


def test_interrupt_after_the_command_is_130_too(monkeypatch):
    """Between the end of a command and the end of the process."""

    def interrupted(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("tvsbayes.cli.main.run", interrupted)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130


@pytest.mark.parametrize(("blocks", "kept"), [(0, False), (1, True)])
def test_an_interrupted_fit_with_a_stored_chain_names_resume(say, monkeypatch, blocks, kept):
    """The chain is announced once when it begins; before its first block of steps none is stored."""

    def interrupted(*_, progress, **__):
        for _ in range(1 + blocks):
            progress(Progress(f"{SAMPLING}: {walking(CHAIN)}", 0.5, 1.0, None))
        raise KeyboardInterrupt

    monkeypatch.setattr("tvsbayes.cli.estimate_commands.compile_for", lambda tell: None)
    monkeypatch.setattr("tvsbayes.cli.estimate_commands.calibrate", interrupted)
    code, out, log = say("fit", PAPER_TWIN)
    assert (code, out) == (130, "") and ("chain.npz; go on with --resume" in log) == kept


def test_a_bug_is_no_bad_input(reading):
    """Only errors a user can act on become exit codes; anything else must not be hidden."""
    reading(RuntimeError("a bug"))
    with pytest.raises(RuntimeError, match="a bug"):
        run(["classic", str(PAPER_TWIN)])


def test_the_version_is_the_packages(say):
    assert say("--version")[:2] == (0, f"tvsbayes {version('tvsbayes')}\n")


def test_help_loads_nothing_heavy_and_lists_the_commands():
    """NumPy among them: `main` sets the number of OpenBLAS' threads, which is read when NumPy is first imported."""
    heavy = "numpy jax cv2 scipy rich.table arviz emcee matplotlib equinox optimistix".split()
    code = (
        "import sys; from tvsbayes.cli.main import run; code = run(['--help']); "
        f"print([name for name in {heavy!r} if name in sys.modules], code, file=sys.stderr)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stderr.strip() == "[] 0"
    for command in ("demo", "new", "simulate", "check", "classic", "fit"):
        assert f"  {command} " in result.stdout


def test_main_silences_messages_of_xla(monkeypatch):
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "")
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
    monkeypatch.setattr(sys, "argv", ["tvsbayes", "--help"])
    with pytest.raises(SystemExit):
        main()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
