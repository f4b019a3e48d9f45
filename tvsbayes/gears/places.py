"""Places at which errors by position have their values: every position read, or even nodes. NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PLACES_MAX, NODES = 60, 41
"""Largest number of positions at which the processes have a value each; more are interpolated from so many nodes."""


@dataclass(frozen=True)
class ProcessPlaces:
    """Places of the processes of position.

    Attributes:
        command: commands of the places, ascending, shape (places,).
        exact: whether every position with readings is a place; else places are evenly spaced.
    """

    command: np.ndarray
    exact: bool

    @classmethod
    def of(cls, commands: np.ndarray, more: np.ndarray) -> ProcessPlaces:
        """Places for rows at `commands` and further evaluations at `more`; none for no rows."""
        places = np.unique(np.concatenate([commands, more])) if len(commands) else commands
        exact = len(np.unique(commands)) <= PLACES_MAX
        return cls(places if exact else np.linspace(places[0], places[-1], NODES), exact)

    def weights(self, command: np.ndarray) -> np.ndarray:
        """Weight of each place at commands (n,): shape (n, places).

        Raises:
            ValueError: a command is not a place, where places are exact.
        """
        weights = np.zeros((len(command), len(self.command)))
        if not len(self.command):
            return weights
        rows = np.arange(len(command))
        if self.exact:
            nearest = np.searchsorted(self.command, command)
            if not np.array_equal(self.command[np.minimum(nearest, len(self.command) - 1)], command):
                raise ValueError("a command at which no process stands")
            weights[rows, nearest] = 1.0
            return weights
        spacing = self.command[1] - self.command[0]
        first = np.clip(((command - self.command[0]) // spacing).astype(int) - 1, 0, len(self.command) - 4)
        t = (command - self.command[first]) / spacing
        # Lagrange's polynomial of third order through four nodes.
        for k in range(4):
            weights[rows, first + k] = np.prod([(t - j) / (k - j) for j in range(4) if j != k], axis=0)
        return weights
