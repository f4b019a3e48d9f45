"""The devices of a run."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tvsbayes.acquisition.observation import Observer
from tvsbayes.acquisition.operator import Operator
from tvsbayes.positioner.interface import Clock, Positioner


@dataclass(frozen=True)
class Bench:
    """The devices and services of a run.

    Attributes:
        positioner: connected.
        observer: takes the looks.
        operator: asked before the laser comes on and for every sheet.
        clock: clock for settling.
        utc: the time of day, for `time_s`.
        details: entries on device and cameras, for the event `start`.
        annotate: returns further entries of every motion's event (the twin's true angles).
        conclude: called with the campaign folder once the run has ended.
        warnings: shown before the run begins.
    """

    positioner: Positioner
    observer: Observer
    operator: Operator
    clock: Clock
    utc: Callable[[], datetime.datetime]
    details: Mapping[str, Any] = field(default_factory=dict)
    annotate: Callable[[], Mapping[str, Any]] = dict
    conclude: Callable[[Path], None] = lambda folder: None
    warnings: tuple[str, ...] = ()
