"""Project 5: the effect of a change in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb


def mean_score(chances: Sequence[float]) -> float:
    """Returns the mean score by (4), 0 to 100, for stages with these chances of success, in their order."""
    passed, total = 1.0, 0.0
    for chance in chances:
        passed *= chance
        total += passed
    return 100 * total / len(chances)


def by_luck(better: int, worse: int) -> float:
    """Returns the probability that equal versions differ at least by this much, in either direction: of the seeds on
    which they differ, one version wins `better` and the other `worse`."""
    differ = better + worse
    one_side = sum(comb(differ, wins) for wins in range(max(better, worse), differ + 1)) / 2**differ
    return min(1.0, 2 * one_side)
