"""Runs on the device model and the twin whose parts a test can reach, and the plans that they follow."""

from __future__ import annotations

import datetime
import signal
from pathlib import Path

from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.engine import Acquisition
from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.operator import StopKey
from tvsbayes.acquisition.session import begin
from tvsbayes.acquisition.simulated_bench import SIMULATED_START, SimulatedOperator, TwinObserver
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.plan import PlanStep

RIG_FILE = shipped_data() / "rigs" / "mounted" / "rig.toml"


SPOT_SD_PX = 0.08
HEADER = {"name": "test", "created": SIMULATED_START.isoformat(), "synthetic": True, "seed": 5}


def small_plan(experiments: int = 2, rehome: bool = False) -> list[PlanStep]:
    """The paper's four points, `experiments` times, of alternating sense; with `rehome` a homing before each."""
    steps: list[tuple] = [("home", 0, 0), ("move", 40, 0), ("move", 0, 0)]
    at = 0
    for number in range(experiments):
        if rehome and number:
            steps += [("home", at, 0)]
        steps += [("place", "d1"), ("look", number, 1), ("place", "d2"), ("look", number, 2)]
        at = 100 - at
        steps += [("move", at, 0), ("look", number, 3), ("place", "d1"), ("look", number, 4)]
    plan = []
    for row, (action, *rest) in enumerate(steps):
        if action == "place":
            plan.append(PlanStep(row, action, target=rest[0]))
        elif action == "look":
            plan.append(PlanStep(row, action, experiment=rest[0], point=rest[1]))
        else:
            plan.append(PlanStep(row, action, *rest))
    return plan


class Run:
    """An acquisition whose parts a test can reach; at its look number `at` something happens, with the laser on."""

    def __init__(
        self, rig, folder, plan=None, *, at=0, then=None, resume=False, start=0, operator=None, observer=None, **options
    ):
        self.folder, self.plan = Path(folder), plan or small_plan()
        self.instrument = Instrument(rig, 5, start)
        self.lit_while_moving = []
        moved = self.instrument.mechanics.moved

        def watch(axis, steps):
            self.lit_while_moving.append(self.instrument.mechanics.laser_on)
            moved(axis, steps)

        self.instrument.mechanics.moved = watch
        self.positioner = self.instrument.positioner()
        self.stop = StopKey()
        clock = self.instrument.clock
        offset = 1000.0 * start
        seen = observer(self.instrument) if observer else TwinObserver(self.instrument, SPOT_SD_PX)
        self.engine = Acquisition(
            rig,
            self.plan,
            begin(self.folder, rig, self.plan, resume, HEADER),
            Bench(
                self.positioner,
                Failing(seen, at, then) if then else seen,
                operator(self) if operator else SimulatedOperator(self.instrument),
                clock,
                lambda: SIMULATED_START + datetime.timedelta(seconds=offset + clock.monotonic()),
            ),
            stop=self.stop,
            **options,
        )

    def dark(self) -> bool:
        """Whether the laser is off, never was on in motion, and the line is closed."""
        return not self.instrument.mechanics.laser_on and not any(self.lit_while_moving)


class Failing:
    """An observer that does something at its n-th look, with the laser on."""

    def __init__(self, inner: TwinObserver, at, action):
        self.inner, self.left, self.action = inner, at, action

    def observe(self, positioner, spot):
        self.left -= 1
        if self.left == 0:
            positioner.laser(True)
            self.action(self.inner.instrument)
        return self.inner.observe(positioner, spot)


def raise_error(error):
    raise error


def ctrl_c(_instrument) -> None:
    signal.raise_signal(signal.SIGINT)


def events(folder, name: str) -> list[dict]:
    """The entries of every event of a kind in a journal."""
    return [record.data for record in read_journal(folder).records if record.event == name]
