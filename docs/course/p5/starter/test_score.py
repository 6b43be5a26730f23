"""Requirements of `score.py` of project 5. Tests marked "so far fails" pass with a correct solution."""

import pytest
from score import by_luck, mean_score


@pytest.mark.parametrize(("chance", "score"), [(0.95, 88.1), (0.9, 77.4), (0.8, 59.0)])
def test_stages_count_as_long_as_all_before_them_are_passed(chance, score):
    """So far fails: each stage counts independently."""
    assert mean_score([chance] * 4) == pytest.approx(score, abs=0.05)


def test_the_first_stage_weighs_most():
    """So far fails: all stages have the same weight."""
    assert mean_score([0.75, 14 / 15, 12 / 14, 0.5]) == pytest.approx(58.75)
    assert mean_score([0.5, 1, 1, 1]) == pytest.approx(50.0)
    assert mean_score([1, 1, 1, 0.5]) == pytest.approx(87.5)


def test_what_always_succeeds_gets_all():
    assert mean_score([1.0] * 4) == 100.0


@pytest.mark.parametrize(
    ("better", "worse", "chance"), [(4, 0, 1 / 8), (6, 0, 1 / 32), (4, 1, 12 / 32), (0, 4, 1 / 8), (12, 3, 0.0352)]
)
def test_a_difference_may_be_luck(better, worse, chance):
    """So far fails: every improvement counts as significant."""
    assert by_luck(better, worse) == pytest.approx(chance, abs=1e-4)


@pytest.mark.parametrize("each", [0, 1, 3])
def test_no_difference_is_luck(each):
    assert by_luck(each, each) == 1.0
