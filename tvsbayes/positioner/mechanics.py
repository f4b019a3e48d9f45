"""State hidden from a positioner's firmware: the true positions of motors and switches, and broken wires.

`Mechanics` can lose steps. It reports every stretch of motion in one sense to a listener, which drives the twin's
gears. Positions are motor steps (pan, tilt).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class Mechanics:
    """Motors, switches and laser of a simulated positioner.

    Attributes:
        home_steps: true position (pan, tilt) at and below which the home switch is pressed.
        limit_steps: distance from 0 beyond which a limit switch opens.
        limit_cut: whether the wire of an axis' limit switches is broken.
        home_dead: whether the wire of an axis' home switch is broken: it never reads as pressed.
        wrong_reads: next readings of an axis' home switch that are wrong: bounce, or a spike.
        true_steps: positions of the motors; they start at 0, whatever the counters.
        missing_steps: number of next steps that the motors lose.
        laser_on: whether the laser emits.
        lit: how often the laser was switched on.
        trigger_on: whether the cameras' trigger line is high.
        moved: called with axis and signed steps after every stretch of motion in one sense.
        found_home: called with the axis when homing has found its switch, at `home_steps`.
    """

    home_steps: tuple[int, int] = (-1_200, -700)
    limit_steps: int = 30_000
    limit_cut: list[bool] = field(default_factory=lambda: [False, False])
    home_dead: list[bool] = field(default_factory=lambda: [False, False])
    wrong_reads: list[int] = field(default_factory=lambda: [0, 0])
    true_steps: list[int] = field(default_factory=lambda: [0, 0])
    missing_steps: list[int] = field(default_factory=lambda: [0, 0])
    laser_on: bool = False
    lit: int = 0
    trigger_on: bool = False
    moved: Callable[[int, int], None] | None = None
    found_home: Callable[[int], None] | None = None
    _stretch: list[int] = field(default_factory=lambda: [0, 0])

    def switch_laser(self, on: bool) -> None:
        """Set the laser's line high or low."""
        self.lit += on and not self.laser_on
        self.laser_on = on

    def step(self, axis: int, sense: int) -> None:
        """One pulse to a motor; `sense` is +1 or -1."""
        if self.missing_steps[axis] > 0:
            self.missing_steps[axis] -= 1
            return
        self.true_steps[axis] += sense
        if self._stretch[axis] * sense < 0:
            self.flush(axis)
        self._stretch[axis] += sense

    def flush(self, axis: int) -> None:
        """Report the present stretch of motion to the listener."""
        stretch, self._stretch[axis] = self._stretch[axis], 0
        if stretch and self.moved is not None:
            self.moved(axis, stretch)

    def home_switch(self, axis: int) -> bool:
        """Whether the home switch reads as pressed."""
        pressed = not self.home_dead[axis] and self.true_steps[axis] <= self.home_steps[axis]
        if self.wrong_reads[axis] == 0:
            return pressed
        self.wrong_reads[axis] -= 1
        return not pressed

    def limit_switch(self, axis: int) -> bool:
        """Whether the limit circuit of an axis is open."""
        return self.limit_cut[axis] or abs(self.true_steps[axis]) > self.limit_steps
