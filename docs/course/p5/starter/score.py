"""Project 5: the effect of a change in numbers. Work in this file."""

from __future__ import annotations

from collections.abc import Sequence


def mean_score(chances: Sequence[float]) -> float:
    """Returns the mean score by (4), 0 to 100, for stages with these chances of success, in their order."""
    # To do: for now as if each stage were independent of the previous ones.
    return 100 * sum(chances) / len(chances)


def by_luck(better: int, worse: int) -> float:
    """Returns the probability that equal versions differ at least by this much, in either direction: of the seeds on
    which they differ, one version wins `better` and the other `worse`."""
    # To do: for now every improvement counts as significant.
    return 0.0 if better > worse else 1.0
