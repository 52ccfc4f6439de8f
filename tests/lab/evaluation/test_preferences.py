"""A blind comparison: who sees what, and what the answers say."""

from collections import Counter

import numpy as np
import pytest

from sfms_robot.lab.evaluation.preferences import NEITHER, QUESTIONS, Preference, bradley_terry, summary, trials


def answers(counts, question="person", left="a", right="b", people=1):
    """`counts`: chosen -> how often."""
    flat = [chosen for chosen, count in counts.items() for _ in range(count)]
    return [Preference(f"p{n % people}", n, n, question, left, right, chosen) for n, chosen in enumerate(flat)]


def test_everybody_sees_every_pair_with_every_voice_once_in_an_order_of_ones_own():
    shown = trials(["a", "b", "c"], 4, seed=1, participant="x")
    pairs = Counter((trial.voice, frozenset((trial.left, trial.right))) for trial in shown)
    assert len(pairs) == 12 and set(pairs.values()) == {1} and [t.number for t in shown] == list(range(12))
    assert shown == trials(["a", "b", "c"], 4, seed=1, participant="x")
    assert shown != trials(["a", "b", "c"], 4, seed=1, participant="y")


def test_sides_are_even_over_people():
    left = sum(trial.left == "a" for n in range(200) for trial in trials(["a", "b"], 5, 0, str(n)))
    assert left / 1000 == pytest.approx(0.5, abs=0.06)


def test_a_pair_has_its_exact_interval_and_test():
    told = summary(answers({"a": 8, "b": 2, NEITHER: 3}))
    (row,) = told["rows"]
    assert (row["first_chosen"], row["second_chosen"], row["neither"], row["share"]) == (8, 2, 3, 0.8)
    assert row["interval"] == pytest.approx([0.4439, 0.9748], abs=1e-4)  # Clopper and Pearson
    assert row["p"] == pytest.approx(0.109375)  # 2 (C(10,8) + C(10,9) + C(10,10)) / 2^10
    assert told["sides"] == {"left": 8, "right": 2} and told["bradley_terry"] == {}


def test_sides_do_not_matter_to_who_is_preferred():
    told = summary(answers({"a": 3}) + answers({"a": 4}, left="b", right="a"))
    assert told["rows"][0]["first_chosen"] == 7 and told["sides"] == {"left": 3, "right": 4}


def test_nobody_has_answered():
    assert summary([])["rows"] == [] and summary([])["answers"] == 0
    (row,) = summary(answers({NEITHER: 2}))["rows"]
    assert row["share"] is None and row["interval"] is None


def test_strengths_are_found_again():
    rng, true = np.random.default_rng(0), np.array([0.8, 0.1, -0.9])
    wins = np.zeros((3, 3))
    for one in range(3):
        for other in range(one):
            won = rng.binomial(4000, 1 / (1 + np.exp(true[other] - true[one])))
            wins[one, other], wins[other, one] = won, 4000 - won
    np.testing.assert_allclose(bradley_terry(wins), true, atol=0.08)


def test_who_always_wins_has_a_finite_strength_and_intervals_need_people():
    given = answers({"a": 6}, people=3) + answers({"b": 6}, left="b", right="c", people=3)
    strengths = summary(given)["bradley_terry"]["person"]
    assert strengths["a"]["strength"] > strengths["b"]["strength"] > strengths["c"]["strength"]
    low, high = strengths["a"]["interval"]
    assert low <= strengths["a"]["strength"] <= high and np.isfinite([low, high]).all()
    alone = summary(answers({"a": 6}) + answers({"b": 6}, left="b", right="c"))["bradley_terry"]["person"]
    assert alone["a"]["interval"] is None and set(QUESTIONS) >= {"person", "attentive", "natural", "in_time"}
