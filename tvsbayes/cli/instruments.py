"""The instruments that commands serve beside the scanner: a list, and the one place that asks which one a folder is of.

A room of commands is a module with a function for every command that the instrument has (`fit`, `plan`, `check` ...):
the folder first, then the options by their names. An option that it does not take is refused, as is a command.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from tvsbayes.cli.app import refuse_options
from tvsbayes.errors import InputError, escaped


@dataclass(frozen=True)
class Instrument:
    """An instrument beside the scanner.

    Attributes:
        words: with their article, as a sentence names it.
        folder: the same of its campaign folder.
        commands: module of its commands.
        served: what to do instead of a command that it does not have.
        remedies: the same for single commands and for their options, by the name of the command.
        shared: commands of the scanner that serve it as they are.
    """

    words: str
    folder: str
    commands: str
    served: str
    remedies: dict[str, str] = field(default_factory=dict)
    shared: tuple[str, ...] = ()

    def command(self, name: str) -> Any:
        """Its function for a command, None where it has none."""
        return getattr(import_module(self.commands), name.replace("-", "_"), None)

    def carry_out(self, name: str, path: Path, **options: object) -> None:
        """Run one of its commands.

        Args:
            name: of the command.
            path: campaign folder.
            options: all that `tvsbayes` knows for it; None or False where not given.

        Raises:
            InputError: it does not have the command, or does not take an option that is given.
        """
        function = self.command(name)
        if function is None:
            message = f"{name} is for a scanner, not {self.words}, and {escaped(str(path), 200)} is {self.folder}"
            raise InputError("usage", message, remedy=self.remedies.get(name, self.served))
        taken = inspect.signature(function).parameters
        unfit = {option: value for option, value in options.items() if option not in taken}
        remedy = self.remedies.get(name, "leave it out")
        refuse_options(f"for a scanner, and this is {self.folder}", remedy, **unfit)
        function(path, **{option: value for option, value in options.items() if option in taken})


INSTRUMENTS = {
    "axis": Instrument(
        "an axis",
        "an axis folder",
        "tvsbayes.cli.axis_commands",
        "of an axis: check, classic, fit, calibrate, compare --by positions, report, plan --given",
        {
            "fit": "leave it out, or state priors in [axis]",
            "view": "`tvsbayes report` makes the page of an axis",
            "watch": "use compare --by positions",
        },
    ),
    "pan-tilt-sightings": Instrument(
        "a head that says where it points",
        "the folder of one",
        "tvsbayes.cli.head_commands",
        "of such a head: check, classic, fit, compare, report, watch, verify, plan, study, compensate --to urdf, "
        "steps-for --azimuth-deg --elevation-deg",
        {"calibrate": "fit, then report"},
        ("import", "check", "fit", "compare", "steps-for", "watch", "plan"),
    ),
}
"""By mechanism, as `campaign.toml` states it."""


def instrument_of(path: Path | None) -> Instrument | None:
    """Whose campaign folder this is: of an instrument of the list; None of a scanner, and where none can be read."""
    from tvsbayes.instrument.campaign_header import mechanism_of

    return None if path is None else INSTRUMENTS.get(mechanism_of(path))


def serve(command: str, campaign: Path | None, **options: object) -> bool:
    """Whether a folder is of an instrument of the list, which has then carried the command out.

    A command that begins with it hands on `locals()`: its options by name.

    Raises:
        InputError: as `Instrument.carry_out`.
    """
    instrument = instrument_of(campaign)
    if campaign is None or instrument is None or command in instrument.shared:
        return False
    instrument.carry_out(command, campaign, **options)
    return True
