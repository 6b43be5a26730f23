"""Project 5: what a change brings, by numbers. Yours to fill in."""

from __future__ import annotations

from collections.abc import Sequence


def mean_score(chances: Sequence[float]) -> float:
    """Returns the mean score by (4), 0 to 100, of stages that succeed with these chances, in their order."""
    # So far: as if each stage could be flown without those before it.
    return 100 * sum(chances) / len(chances)


def by_luck(better: int, worse: int) -> float:
    """Returns how often equal versions differ so much or more, either way: of the seeds on which they differ, one
    version wins `better` and the other `worse`."""
    # So far: whatever is better is no luck.
    return 0.0 if better > worse else 1.0
