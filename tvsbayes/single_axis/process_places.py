"""Where the processes of position stand: at every position that was read, or at even nodes where there are many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PLACES_MAX = 60
"""Positions up to which both processes stand at every one of them; beyond it at `NODES` nodes, lines of third order
in between."""
NODES = 41


@dataclass(frozen=True)
class ProcessPlaces:
    """Where the processes of position stand.

    Attributes:
        command: their places, ascending, shape (places,).
        exact: whether every position that was read is one of them; else places are even.
    """

    command: np.ndarray
    exact: bool

    def weights(self, command: np.ndarray) -> np.ndarray:
        """What each place contributes at commands (n,): shape (n, places).

        Raises:
            ValueError: a command that is no place, of exact ones.
        """
        weights_at = np.zeros((len(command), len(self.command)))
        if not len(self.command):
            return weights_at
        if self.exact:
            at = np.searchsorted(self.command, command)
            if not np.array_equal(self.command[np.minimum(at, len(self.command) - 1)], command):
                raise ValueError("a command at which no process stands")
            weights_at[np.arange(len(command)), at] = 1.0
            return weights_at
        spacing = self.command[1] - self.command[0]
        first = np.clip(((command - self.command[0]) // spacing).astype(int) - 1, 0, len(self.command) - 4)
        t = (command - self.command[first]) / spacing
        # Lagrange's polynomial of third order through four nodes.
        for k in range(4):
            others = [j for j in range(4) if j != k]
            weights_at[np.arange(len(command)), first + k] = np.prod([(t - j) / (k - j) for j in others], axis=0)
        return weights_at


def process_places(commands: np.ndarray, more: np.ndarray) -> ProcessPlaces:
    """For rows at `commands` and whatever is asked for at `more`; none for no rows."""
    if not len(commands):
        return ProcessPlaces(commands, True)
    every = np.unique(np.concatenate([commands, more]))
    if len(np.unique(commands)) <= PLACES_MAX:
        return ProcessPlaces(every, True)
    return ProcessPlaces(np.linspace(every[0], every[-1], NODES), False)
