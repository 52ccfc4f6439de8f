"""An interval holds the truth about as often as it says, and hangs on people, not on how their minutes are cut."""

import numpy as np
import pytest
from scipy.stats import t as student_t
from tiny_arig_training import dyad

from sfms_robot.lab.evaluation.intervals import bootstrap, distance, estimates, intervals, people_of, quotient, ratio


def people(rng, count=24, mean=2.0):
    """People whose true rates scatter around `mean` a minute, each watched for 20 minutes."""
    return [{"nods": np.array([rng.poisson(20 * rate), 20.0])} for rate in rng.gamma(4, mean / 4, count)]


def test_an_interval_holds_the_truth_at_about_its_level():
    held = 0
    for trial in range(300):
        found = estimates({"rate": quotient("nods")}, people(np.random.default_rng(trial)), seed=trial, draws=400)
        low, high = found["rate"].interval
        held += low <= 2.0 <= high
    assert 0.88 <= held / 300 <= 0.98  # 0.95, less a little for so few people


def test_values_are_those_of_the_sums_and_none_without_a_count_a_second_person_or_most_draws():
    rows = [{"a": np.array(a), "b": np.array(b)} for a, b in (([3.0, 1.0], [1.0, 2.0]), ([1.0, 3.0], [3.0, 2.0]))]
    found = estimates({"a": quotient("a"), "a over b": ratio("a", "b")}, rows, seed=1)
    assert (found["a"].value, found["a over b"].value) == (1.0, 1.0)
    found = estimates({"a": quotient("a"), "r": ratio("b", "a")}, [{"a": np.zeros(2), "b": np.ones(2)}] * 5, seed=1)
    assert found["a"].value is None and found["a"].interval is None and found["r"].value is None
    assert estimates({"a": quotient("a")}, [{"a": np.ones(2)}], seed=1)["a"].interval is None
    rows = [{"a": np.array([1.0, 1.0])}, *[{"a": np.zeros(2)}] * 9]
    found = estimates({"a": quotient("a")}, rows, seed=1)["a"]
    assert found.value == 1.0 and found.interval is None


def test_the_distance_of_two_histograms():
    apart = [{"a": np.array([1.0, 0, 0]), "b": np.array([0, 0, 1.0]), "c": np.array([1.0, 1, 0])}] * 3
    found = estimates({"a a": distance("a", "a"), "a b": distance("a", "b"), "a c": distance("a", "c")}, apart, seed=1)
    assert [found[key].value for key in ("a a", "a b", "a c")] == [0.0, 1.0, pytest.approx(0.5)]


def _mean_of(values):
    return lambda clips: {"mean": float(values[clips].mean()), "unknown": float("nan")}


def _interval(values, people, **more):
    return intervals(bootstrap(_mean_of(values), people, **more))


def test_intervals_over_people_are_those_of_their_means() -> None:
    """One clip each: the interval of a mean is about Student's, and a figure that is never defined has none."""
    values = np.random.default_rng(0).normal(3.0, 2.0, 40)
    found = _interval(values, [str(number) for number in range(40)], draws=2000)
    low, high = student_t.interval(0.95, 39, values.mean(), values.std(ddof=1) / np.sqrt(40))
    assert found == {"mean": (pytest.approx(low, abs=0.1), pytest.approx(high, abs=0.1))}


def test_clips_of_one_person_hang_together() -> None:
    values = np.repeat(np.random.default_rng(1).normal(0, 1, 6), 50)
    low, high = _interval(values, [str(number) for number in np.repeat(range(6), 50)])["mean"]
    near, far = _interval(values, [str(number) for number in range(300)])["mean"]
    assert high - low > 3 * (far - near)
    assert bootstrap(_mean_of(values), ["a", "b"] * 150) == {}


def test_an_interval_of_clips_is_never_negative_and_widens_with_trainings_that_differ() -> None:
    values = np.random.default_rng(2).exponential(1.0, 6) ** 4
    assert _interval(values, [*"abcdef"])["mean"][0] > 0
    values = np.repeat([0.0, 1.0, 5.0], 10) + np.tile(np.linspace(0, 0.1, 10), 3)
    people, runs = [*"abcdefghij"] * 3, np.repeat(range(3), 10).tolist()
    (low, high), (near, far) = (_interval(values, people, runs=each)["mean"] for each in (runs, ()))
    assert high - low > 10 * (far - near)
    values = np.random.default_rng(3).normal(0, 5, 20)
    people = [str(number) for number in range(20)]
    ours, theirs = (bootstrap(_mean_of(each), people)["mean"] for each in (values + 0.1, values))
    assert ours - theirs == pytest.approx(0.1)


def test_who_listens_is_told_by_seat_and_series_or_by_name() -> None:
    dyads = [dyad(name, "listening", 0) for name in ("IS1000a_B_0120", "IS1000d_B_0007", "IS1000a_C_0120", "clip_7")]
    assert people_of(dyads, [250, 600, 249, 300], 250) == ["IS1000 B"] * 3 + ["clip_7"]
