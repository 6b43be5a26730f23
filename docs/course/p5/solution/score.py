"""Project 5: what a change brings, by numbers."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb


def mean_score(chances: Sequence[float]) -> float:
    """Returns the mean score by (4), 0 to 100, of stages that succeed with these chances, in their order."""
    passed, total = 1.0, 0.0
    for chance in chances:
        passed *= chance
        total += passed
    return 100 * total / len(chances)


def by_luck(better: int, worse: int) -> float:
    """Returns how often equal versions differ so much or more, either way: of the seeds on which they differ, one
    version wins `better` and the other `worse`."""
    differ = better + worse
    one_side = sum(comb(differ, wins) for wins in range(max(better, worse), differ + 1)) / 2**differ
    return min(1.0, 2 * one_side)
