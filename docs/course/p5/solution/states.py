"""Project 5: the table of states, and their timeouts."""

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


# The stage determines what to look for and fly through; the states are the same for all stages.
TABLE = {
    "search": State(most_s=20.0, well="approach", otherwise="elsewhere"),
    "elsewhere": State(most_s=5.0, well="search", otherwise="search"),
    "approach": State(most_s=20.0, well="pass", otherwise="elsewhere"),
    "pass": State(most_s=15.0, well="next", otherwise="elsewhere"),
    "next": State(most_s=1.0, well="search", otherwise=END),
}


def timed(steps: Generator[T, None, bool], most_s: float, clock: Callable[[], float]) -> Generator[T, None, bool]:
    """Runs the steps of a state until its timeout; returns whether it succeeded.

    `steps` yields one reply for each image, and returns whether it succeeded. `clock` returns the time of the image
    [s]. After `most_s` since the first image, no further step is requested, and the state has failed.
    """
    until_s = clock() + most_s
    while clock() < until_s:
        try:
            step = next(steps)
        except StopIteration as end:
            return bool(end.value)
        yield step
    steps.close()
    return False
