"""Project 5: the table of states, and what leaves one of them when its time is over."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import NamedTuple, TypeVar

T = TypeVar("T")

# Where every flight begins, and what no state leads back from.
FIRST, END = "search", "end"


class State(NamedTuple):
    """One line of the table."""

    most_s: float
    """After this it has not ended well. [s]"""
    well: str
    """The state after it has ended well."""
    otherwise: str
    """The state after it has not."""


# What is looked for, and flown through, is a matter of the stage; the states are the same for all.
TABLE = {
    "search": State(most_s=20.0, well="approach", otherwise="elsewhere"),
    "elsewhere": State(most_s=5.0, well="search", otherwise="search"),
    "approach": State(most_s=20.0, well="pass", otherwise="elsewhere"),
    "pass": State(most_s=15.0, well="next", otherwise="elsewhere"),
    "next": State(most_s=1.0, well="search", otherwise=END),
}


def timed(steps: Generator[T, None, bool], most_s: float, clock: Callable[[], float]) -> Generator[T, None, bool]:
    """Goes through the steps of a state, as long as it may take; returns whether it ended well.

    `steps` gives one answer for each image, and returns whether it ended well. `clock` tells the time of the image
    [s]. Once `most_s` have gone by since the first image, no further step is asked for, and it has not ended well.
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
