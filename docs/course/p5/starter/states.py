"""Project 5: the table of states, and their timeouts. Work in this file."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import NamedTuple, TypeVar

T = TypeVar("T")

# First state of every flight, and the final state.
FIRST, END = "search", "end"


class State(NamedTuple):
    """One row of the table."""

    most_s: float
    """Timeout, after which the state has failed. [s]"""
    well: str
    """Next state after success."""
    otherwise: str
    """Next state after failure or timeout."""


# To do: for now it looks once, without a timeout, and gives up. Your table is longer, and each timeout is shorter than
# the flight's.
TABLE = {
    "search": State(most_s=float("inf"), well=END, otherwise=END),
}


def timed(steps: Generator[T, None, bool], most_s: float, clock: Callable[[], float]) -> Generator[T, None, bool]:
    """Runs the steps of a state until its timeout; returns whether it succeeded.

    `steps` yields one reply for each image, and returns whether it succeeded. `clock` returns the time of the image
    [s]. After `most_s` since the first image, no further step is requested, and the state has failed.
    """
    # To do: for now there is no timeout.
    return (yield from steps)
