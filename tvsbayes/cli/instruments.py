"""The instruments other than the scanner, with dispatch: find the instrument of a folder and run its command.

Each instrument has a module with a function for each of its commands (`fit`, `plan`, `check` ...), which takes the
folder first, then the options by their names. Unknown options and commands are refused.
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
    """An instrument other than the scanner.

    Attributes:
        words: its name in a sentence, with article.
        folder: name of its campaign folder in a sentence, with article.
        commands: module of its commands.
        served: remedy for a command that it lacks.
        remedies: remedies for single commands and their options, by the name of the command.
        shared: commands of the scanner that it uses unchanged.
    """

    words: str
    folder: str
    commands: str
    served: str
    remedies: dict[str, str] = field(default_factory=dict)
    shared: tuple[str, ...] = ()

    def command(self, name: str) -> Any:
        """Its function for a command; None if none."""
        return getattr(import_module(self.commands), name.replace("-", "_"), None)

    def carry_out(self, name: str, path: Path, **options: object) -> None:
        """Run one of its commands.

        Args:
            name: name of the command.
            path: campaign folder.
            options: all options of the command; None or False where not given.

        Raises:
            InputError: an unknown command, or an unknown option that is given.
        """
        function = self.command(name)
        if function is None:
            message = f"{name} is for a scanner, not {self.words}, and {escaped(str(path), 200)} is {self.folder}"
            raise InputError("usage", message, remedy=self.remedies.get(name, self.served))
        parameters = inspect.signature(function).parameters
        refused = {option: value for option, value in options.items() if option not in parameters}
        remedy = self.remedies.get(name, "leave it out")
        refuse_options(f"for a scanner, and this is {self.folder}", remedy, **refused)
        function(path, **{option: value for option, value in options.items() if option in parameters})


INSTRUMENTS = {
    "axis": Instrument(
        "an axis",
        "an axis folder",
        "tvsbayes.cli.axis_commands",
        "of an axis: check, classic, fit, calibrate, compare, watch, report, plan --given",
        {
            "fit": "leave it out, or state priors in [axis]",
            "view": "`tvsbayes report` makes the page of an axis",
        },
    ),
    "pan-tilt": Instrument(
        "a head that turns a laser",
        "the folder of a head",
        "tvsbayes.cli.head_commands",
        "fit, then report",
        shared=(
            *("simulate", "check", "detect", "view", "export", "locate", "steps-for", "plan", "watch"),
            *("classic", "fit", "compare", "import"),
        ),
    ),
    "pan-tilt-sightings": Instrument(
        "a head that says where it points",
        "the folder of a head",
        "tvsbayes.cli.head_commands",
        "of such a head: check, classic, fit, compare, report, watch, verify, plan, study, compensate --to urdf, "
        "steps-for --azimuth-deg --elevation-deg",
        {"calibrate": "fit, then report"},
        ("import", "check", "fit", "compare", "steps-for", "watch", "plan"),
    ),
}
"""Instruments by mechanism, as in `campaign.toml`."""


def instrument_of(path: Path | None) -> Instrument | None:
    """The instrument of a campaign folder; None for a scanner, and where no header can be read."""
    from tvsbayes.instrument.campaign_header import mechanism_key

    return None if path is None else INSTRUMENTS.get(mechanism_key(path))


def refuse_mixed(first: Path, second: Path) -> None:
    """Refuse two folders of which one is that of an axis.

    Raises:
        InputError: they are.
    """
    kinds = [instrument_of(folder) is INSTRUMENTS["axis"] for folder in (first, second)]
    if kinds[0] != kinds[1]:
        named = escaped(str(second if kinds[1] else first), 200)
        message = f"{named} is an axis folder, and the other folder is not"
        raise InputError("usage", message, remedy="name two folders of one instrument")


def serve(command: str, campaign: Path | None, **options: object) -> bool:
    """Run a command if the folder belongs to an instrument of the list; return whether it was run.

    A command calls it first with `locals()`: its options by name.

    Raises:
        InputError: as `Instrument.carry_out`.
    """
    instrument = instrument_of(campaign)
    if campaign is None or instrument is None or command in instrument.shared:
        return False
    instrument.carry_out(command, campaign, **options)
    return True
