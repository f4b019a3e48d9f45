"""Places of the processes of position: every position with readings, or even nodes where there are many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PLACES_MAX = 60
"""Largest number of positions that are places themselves; more are replaced by `NODES` interpolated nodes."""
NODES = 41


@dataclass(frozen=True)
class ProcessPlaces:
    """Places of the processes of position.

    Attributes:
        command: commands of the places, ascending, shape (places,).
        exact: whether every position with readings is a place; else places are evenly spaced.
    """

    command: np.ndarray
    exact: bool

    def weights(self, command: np.ndarray) -> np.ndarray:
        """Weight of each place at commands (n,): shape (n, places).

        Raises:
            ValueError: a command is not a place, where places are exact.
        """
        weights = np.zeros((len(command), len(self.command)))
        if not len(self.command):
            return weights
        if self.exact:
            nearest = np.searchsorted(self.command, command)
            if not np.array_equal(self.command[np.minimum(nearest, len(self.command) - 1)], command):
                raise ValueError("a command at which no process stands")
            weights[np.arange(len(command)), nearest] = 1.0
            return weights
        spacing = self.command[1] - self.command[0]
        first = np.clip(((command - self.command[0]) // spacing).astype(int) - 1, 0, len(self.command) - 4)
        t = (command - self.command[first]) / spacing
        # Lagrange's polynomial of third order through four nodes.
        for k in range(4):
            others = [j for j in range(4) if j != k]
            weights[np.arange(len(command)), first + k] = np.prod([(t - j) / (k - j) for j in others], axis=0)
        return weights


def process_places(commands: np.ndarray, more: np.ndarray) -> ProcessPlaces:
    """Places for rows at `commands` and further evaluations at `more`; none for no rows."""
    if not len(commands):
        return ProcessPlaces(commands, True)
    all_commands = np.unique(np.concatenate([commands, more]))
    if len(np.unique(commands)) <= PLACES_MAX:
        return ProcessPlaces(all_commands, True)
    return ProcessPlaces(np.linspace(all_commands[0], all_commands[-1], NODES), False)
