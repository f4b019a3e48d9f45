"""Does a run survive what strangers do to its page, kills, and damage to its journal; do results, programs, inputs?

    python -m experiments.robustness.attacks > experiments/robustness/attacks.md

A run is `acquire --simulate` of the first rows of the mounted rig's shipped plan, a process that may have 1024
files open. On its live page: idle connections, parallel downloads, requests that must be refused. Memory is that
of Linux' /proc. Then a run is killed at random moments and resumed, and a killed run's journal is damaged: where the
run goes on, nothing that was acknowledged may be lost; where it is refused, no file may change. Last (`further`)
come commands that are killed or do not end, and inputs that could hurt.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import socket
import stat
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from experiments.common.command_line import print_only
from experiments.common.commands import PROGRAM, said
from experiments.common.page import heading, line
from experiments.common.rows import ROOT, commit
from experiments.robustness.command_attacks import further

RIG = ROOT / "data" / "rigs" / "mounted"
SEED, FILES_MAX, IDLE, DOWNLOADS, KILLS = 20261126, 1024, 1100, 200, 10
ATTACKED, KILLED = 400, 130
"""Rows of the plan: of the run with a page, and of those that are killed."""
LATE = ATTACKED // 4
"""Looks after which the memory of a run is read."""
LONGEST_S = 1200.0
"""For a run to come to its end; reached only where it hangs."""


def listing(place: Path) -> dict[str, str]:
    """Kind, target or hash of everything below."""
    state = {}
    for folder, folders, files in os.walk(place):
        for path in (Path(folder) / name for name in (*folders, *files)):
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                state[str(path)] = f"link to {path.readlink()}"
            elif not stat.S_ISREG(mode):
                state[str(path)] = str(stat.S_IFMT(mode))
            elif path.stat().st_size > 5e7:
                # Sparse giants of the folder itself are identified by their size.
                state[str(path)] = str(path.stat().st_size)
            else:
                state[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return state


def looks(folder: Path) -> dict[int, object]:
    """Pixels of every look in the whole lines of a journal, by number."""
    log = folder / "log.jsonl"
    data = log.read_bytes() if log.exists() else b""
    events = [json.loads(row.split(b" ", 3)[3]) for row in data[: data.rfind(b"\n") + 1].splitlines()]
    return {event["spot"]: event["pixels_px"] for event in events if event["event"] == "looked"}


def numbers(folder: Path) -> set[int]:
    """Of the looks in the table."""
    return {int(row.split(",")[0]) for row in (folder / "spots.csv").read_text().splitlines()[1:]}


class Run:
    """`acquire --simulate` in a process of its own; its output goes to a file beside its folder."""

    def __init__(self, rows: int, out: Path, *options: str):
        self.out, self.log, steps = out, out.with_suffix(".txt"), out.with_suffix(".csv")
        steps.write_text("".join((RIG / "planned.csv").read_text().splitlines(keepends=True)[: rows + 1]))
        words = ["acquire", str(RIG / "rig.toml"), str(steps), str(out), "--simulate", "--seed", "3", *options]
        with self.log.open("wb") as stream:
            self.child = subprocess.Popen([*PROGRAM, *words], stdout=stream, stderr=stream, cwd=ROOT)
        resource.prlimit(self.child.pid, resource.RLIMIT_NOFILE, (FILES_MAX, FILES_MAX))

    def until[T](self, done: Callable[[], T]) -> T:
        """Wait for a condition or the end of the run; the condition's value."""
        end = time.monotonic() + LONGEST_S
        while not (value := done()) and self.child.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        return value

    def looked(self, count: int) -> None:
        """Wait for so many looks."""
        self.until(lambda: len(looks(self.out)) >= count)

    def memory_mb(self, name: str = "VmRSS") -> float:
        """Resident memory, or another entry of the process's status."""
        status = Path(f"/proc/{self.child.pid}/status").read_text()
        return int(re.search(rf"{name}:\s+(\d+)", status)[1]) * 1024 / 1e6


def sent(port: int, request: bytes) -> tuple[int, bytes]:
    """Status and content of an answer; 0 where the connection is closed without one."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        try:
            connection.sendall(request)
            answer = b"".join(iter(lambda: connection.recv(65536), b""))
        except OSError:
            return 0, b""
    return (int(answer.split()[1]) if answer.startswith(b"HTTP/") else 0), answer.partition(b"\r\n\r\n")[2]


def http(port: int, path: str, body: bytes | None = None, method: str = "", **headers: str) -> bytes:
    """A request with a good Host, unless another is given; "" leaves a header out."""
    fields = {"Host": f"127.0.0.1:{port}", "Connection": "close"} | {k.replace("_", "-"): v for k, v in headers.items()}
    fields |= {} if body is None or "Content-Length" in fields else {"Content-Length": str(len(body))}
    lines = [f"{method or ('GET' if body is None else 'POST')} {path} HTTP/1.1"]
    return "\r\n".join([*lines, *(f"{k}: {v}" for k, v in fields.items() if v), "", ""]).encode() + (body or b"")


def requests(port: int, token: str) -> list[tuple[bytes, Sequence[int]]]:
    """What is sent, and the answers that refuse it."""
    mine, big = {"X_Tvsbayes_Token": token}, b"0" * 10_000_000
    chunked = {**mine, "Transfer_Encoding": "chunked", "Content_Length": ""}
    hosts = ("evil", f"evil:{port}", f"0.0.0.0:{port}", f"[::1]:{port}", f"127.0.0.1.evil:{port}", "127.0.0.1")
    paths = ("/../live", "/%2e%2e/live", "/..%2flive", "/%c0%ae%c0%ae/live", "//live", "/live/", "/live%00")
    paths += ("/log.jsonl", "/frames/000001_left.png", "/live.html%00.js", "http://evil/x", "/\\..\\live")
    bodies = (b"", b"no", b"[]", b"7", b'{"what": "fire"}', b'{"what": {"what": "stop"}}')
    raw = f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n".encode()
    return [
        *((http(port, "/live", X_Tvsbayes_Token=k), (403,)) for k in ("", "wrong", " ", "\u00fc")),
        *((http(port, "/live", **mine, Origin=o), (403,)) for o in ("http://evil", "null", "http://127.0.0.1:1")),
        (http(port, "/live", **mine, Sec_Fetch_Site="cross-site"), (403,)),
        *((http(port, "/live", **mine, Host=host), (403,)) for host in hosts),
        (raw + f"Host: 127.0.0.1:{port}\r\nX-Tvsbayes-Token: {token}\r\n\r\n".encode(), (400,)),
        (http(port, "/live", **mine, Host=""), (400, 403)),
        *((http(port, path, **mine), (400, 403, 404)) for path in paths),
        (http(port, "/live", method="OPTIONS", Origin="http://evil"), (403,)),
        (http(port, "/live", Origin="http://evil", Upgrade="websocket"), (403,)),
        *((http(port, "/live", body, **mine), (405,)) for body in bodies),
        (http(port, "/live", b'{"what": "stop"}'), (403,)),
        (http(port, "/live", b"5", **chunked | {"Content_Length": "1"}), (400,)),
        (http(port, "/live", b"{}", **mine, Content_Length="1000000000"), (0, 400)),
        (http(port, "/live", big, **mine), (0, 400)),
        (http(port, "/live", b"989680\r\n" + big, **chunked), (0, 400)),
        (http(port, "/live", **mine, X_Long="x" * 200_000), (0, 400, 431)),
        (raw + b"x: y\r\n" * 10_000 + b"\r\n", (0, 400, 403, 431)),
        (http(port, "/live", b"\x1f\x8b0", **mine, Content_Encoding="gzip"), (400, 405)),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500), (0, 400)),
    ]


def attacked(place: Path) -> list[str]:
    """A run with a page left alone, then one attacked."""
    alone = Run(ATTACKED, place / "alone", "--live", "--no-browser")
    alone.looked(LATE)
    peak_alone, codes = alone.memory_mb("VmHWM"), [alone.child.wait(LONGEST_S)]
    run = Run(ATTACKED, place / "attacked", "--live", "--no-browser")
    link = run.until(lambda: re.search(r"http://127\.0\.0\.1:(\d+)/#(\S+)", run.log.read_text()))
    port, token = int(link[1]), link[2]
    waits: list[float] = []

    def still_answers() -> None:
        began = time.monotonic()
        assert sent(port, http(port, "/live", X_Tvsbayes_Token=token))[0] == 200
        waits.append(1000 * (time.monotonic() - began))

    run.looked(5)
    before = run.memory_mb()
    idle = [socket.create_connection(("127.0.0.1", port), timeout=30) for _ in range(IDLE)]
    still_answers()
    descriptors = len(os.listdir(f"/proc/{run.child.pid}/fd"))
    for one in idle:
        one.close()
    with ThreadPoolExecutor(50) as pool:
        taken = Counter(pool.map(lambda _: sent(port, http(port, "/live.js"))[0], range(DOWNLOADS)))
    wrong, listed = [], requests(port, token)
    for request, allowed in listed:
        status, _ = sent(port, request)
        wrong += [] if status in allowed else [f"; {status} for {request[:80]!r}"]
        still_answers()
    after = run.memory_mb()
    run.looked(LATE)
    peak = run.memory_mb("VmHWM")
    codes.append(run.child.wait(LONGEST_S))
    one, other = ((place / name / "spots.csv").read_bytes() for name in ("alone", "attacked"))
    return [
        f"{IDLE} idle connections without the token: {descriptors} of {FILES_MAX} descriptors in use",
        f"{DOWNLOADS} parallel downloads: {taken[200]} answered, {taken[0]} closed",
        f"{len(listed)} requests that must be refused: {len(listed) - len(wrong)} were{''.join(wrong)}",
        f"a request with the token after each: answered, after {max(waits):.0f} ms at most",
        f"memory {before:.0f} MB before, {after:.0f} after; most {peak:.0f}, of an unattacked run {peak_alone:.0f}",
        f"exit codes {codes}, {len(looks(run.out))} looks, spots.csv {'as unattacked' if one == other else 'DIFFERS'}",
    ]


def killed(place: Path) -> list[str]:
    """A run that is killed and resumed; a copy of its folder stays as `killed`."""
    rng, acknowledged = random.Random(SEED), {}
    for kill in range(KILLS):
        run = Run(KILLED, place / "run", *["--resume"] * (kill > 0))
        run.looked(len(acknowledged) + rng.randint(1, 3))
        time.sleep(rng.uniform(0.0, 0.5))
        run.child.send_signal(signal.SIGKILL)
        assert run.child.wait() == -signal.SIGKILL
        acknowledged |= looks(run.out)
    shutil.copytree(place / "run", place / "killed")
    run = Run(KILLED, place / "run", "--resume")
    code, kept = run.child.wait(LONGEST_S), looks(run.out)
    lost, rows = sum(kept.get(spot) != pixels for spot, pixels in acknowledged.items()), len(numbers(run.out))
    return [
        f"{KILLS} kills (SIGKILL), each resumed; exit code of the last {code}, {len(kept)} looks, {rows} in spots.csv",
        f"{len(acknowledged)} looks acknowledged before a kill: {lost} lost",
    ]


K = 20
"""The line that is damaged."""
REWRITTEN: dict[str, Callable[[list[bytes]], list[bytes]]] = {
    "last line torn": lambda of: [*of[:-1], of[-1][:-9]],
    "4 KB of NUL at the end": lambda of: [*of, bytes(4096)],
    "a byte changed": lambda of: [*of[:K], b"x" + of[K][1:], *of[K + 1 :]],
    "a line deleted": lambda of: of[:K] + of[K + 1 :],
    "a line doubled": lambda of: of[: K + 1] + of[K:],
    "two lines swapped": lambda of: [*of[:K], of[K + 1], of[K], *of[K + 2 :]],
    "a line of noise": lambda of: [*of[:K], bytes(range(128, 256)) + b"\n", *of[K:]],
    "CRLF": lambda of: [row.replace(b"\n", b"\r\n") for row in of],
    "a forged line": lambda of: [*of, b'00000000 9 00000000 {"event":"stop"}\n'],
    "second half missing": lambda of: of[: len(of) // 2],
    "a line of 100 MB": lambda of: [*of, b"x" * 100_000_000 + b"\n"],
    "100 000 brackets": lambda of: [*of, b"[" * 100_000 + b"\n"],
    "empty": lambda of: [],
}
INSTEAD: dict[str, Callable[[Path], object]] = {
    "missing": lambda log: None,
    "a FIFO": os.mkfifo,
    "a folder": Path.mkdir,
    "a link outside": lambda log: log.symlink_to("/etc/passwd"),
}
"""What stands where the journal was."""
DAMAGES = (*REWRITTEN, *INSTEAD, "spots.csv edited", "spots.csv deleted")


def damaged(place: Path, what: str) -> str:
    """A row: exit codes of `check` and `acquire --resume`, and what is kept."""
    folder = shutil.copytree(place / "killed", place / "damaged" / what.replace(" ", "_"))
    acknowledged, log, spots = looks(folder).keys(), folder / "log.jsonl", folder / "spots.csv"
    if what in REWRITTEN:
        log.write_bytes(b"".join(REWRITTEN[what](log.read_bytes().splitlines(keepends=True))))
    elif what in INSTEAD:
        log.unlink()
        INSTEAD[what](log)
    elif what == "spots.csv edited":
        spots.write_text(spots.read_text().replace(",ok", ",bad", 1))
    else:
        spots.unlink()
    checked, before = said("check", folder), listing(folder)
    run = Run(KILLED, folder, "--resume")
    code = run.child.wait(LONGEST_S)
    outcome = "refused, no file changed" if listing(folder) == before else "REFUSED, FILES CHANGED"
    if code == 0:
        earlier = "".join(f", earlier rows in {path.name}" for path in folder.glob("spots.*-1.csv"))
        outcome = f"goes on, {len(acknowledged & numbers(folder))} of {len(acknowledged)} looks kept{earlier}"
    traceback = " TRACEBACK" * ("Traceback" in run.log.read_text() + checked.stderr)
    return line(what, checked.returncode, code, outcome + traceback)


def main() -> None:
    print_only(__doc__)
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        print(f"# Attacks on a run\n\n{time.strftime('%Y-%m-%d')}, commit {commit()}.\n\n## Its page\n")
        print(*(f"- {text}" for text in attacked(place)), sep="\n")
        print("\n## Kills\n", *(f"- {text}" for text in killed(place)), sep="\n")
        print("\n## Damaged journals\n\n" + heading("journal | `check` | `acquire --resume` | "))
        print(*(damaged(place, what) for what in DAMAGES), sep="\n")
    print("\n## Results, programs and inputs\n")
    further(random.Random(SEED))


if __name__ == "__main__":
    main()
