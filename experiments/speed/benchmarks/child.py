"""Runs a command and writes what it cost: `python -S child.py RESULT.json LIMIT_S COMMAND ...`.

Linux counts into a process' peak memory what its parent held when it was forked: commands are therefore started from
this program, which imports next to nothing, and not from one that has loaded JAX.
"""

import json
import os
import sys
import time


def main() -> None:
    """Start, wait, kill after the limit, write the result."""
    place, limit_s, *command = sys.argv[1:]
    start = time.perf_counter()
    child = os.posix_spawn(command[0], command, os.environ)
    late = False
    while True:
        # Polled: wait4 alone reports this child's memory, but has no time limit.
        pid, status, usage = os.wait4(child, os.WNOHANG)
        wall_s = time.perf_counter() - start
        if pid:
            break
        if wall_s > float(limit_s) and not late:
            late = True
            os.kill(child, 9)
        time.sleep(0.002 if wall_s < 5 else 0.05)
    result = {
        "late": late,
        "code": os.waitstatus_to_exitcode(status),
        "wall_s": wall_s,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "rss_mib": usage.ru_maxrss / 1024,
    }
    with open(place, "w") as file:
        json.dump(result, file)


if __name__ == "__main__":
    main()
