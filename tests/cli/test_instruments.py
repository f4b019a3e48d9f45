"""The list of instruments: recognition of folders, and the options that their commands take."""

from __future__ import annotations

import inspect

import pytest

from tvsbayes.cli.instruments import INSTRUMENTS, instrument_of
from tvsbayes.cli.main import COMMANDS
from tvsbayes.instrument.campaign_header import mechanism_key
from tvsbayes.instrument.mechanisms import TWO_MIRROR

HANDED_ON = {"out", "issue", "moves", "alone", "certification", "tier"}
"""What a command makes of its options before it hands them on."""


@pytest.mark.parametrize(
    ("text", "mechanism"),
    [
        ('format = "tvsbayes-campaign/1"\n', TWO_MIRROR.key),
        ('format = "tvsbayes-campaign/1"\n[rig]\nmechanism = "pan-tilt"\n', "pan-tilt"),
        ('format = "tvsbayes-axis/1"\n', "axis"),
        ("format = 3\n", "3"),
        ("no TOML", ""),
    ],
)
def test_a_folder_identifies_its_instrument(tmp_path, text, mechanism):
    (tmp_path / "campaign.toml").write_text(text)
    assert mechanism_key(tmp_path) == mechanism
    assert instrument_of(tmp_path) is INSTRUMENTS.get(mechanism)
    assert mechanism_key(tmp_path / "nowhere") == "" and instrument_of(None) is None


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_commands_of_an_instrument_take_only_existing_options(name):
    """A parameter without an option would raise TypeError."""
    commands = {command.__name__.rstrip("_"): set(inspect.signature(command).parameters) for command in COMMANDS}
    for command, known in commands.items():
        function = INSTRUMENTS[name].command(command)
        if function is not None:
            _, *options = inspect.signature(function).parameters
            assert set(options) <= known | HANDED_ON, command
