"""Quantiles in fixed memory: exact while values are few, within one percent after that."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.signals.quantiles import Quantiles


def taken(values):
    quantiles = Quantiles()
    for value in values:
        quantiles.add(value)
    return quantiles


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=200), st.sampled_from([0, 50, 95, 99, 100]))
def test_few_values_give_exact_quantiles(values, percent):
    assert taken(values).at(percent) == np.percentile(values, percent)


@pytest.mark.parametrize("percent", [1, 50, 95, 99, 99.9])
@pytest.mark.parametrize("seed", range(3))
def test_many_values_give_quantiles_within_a_percent(percent, seed):
    values = np.random.default_rng(seed).lognormal(0.0, 2.0, 50_000)
    assert taken(values).at(percent) == pytest.approx(np.percentile(values, percent, method="inverted_cdf"), rel=0.012)


def test_the_largest_is_exact_zeros_stay_zeros_and_nothing_taken_is_none():
    quantiles = taken([*[0.0] * 10_000, 123.456])
    assert (quantiles.at(50), quantiles.at(100), len(quantiles)) == (0.0, 123.456, 10_001)
    assert Quantiles().report(p50=50) == {"p50": None}
    with pytest.raises(ValueError, match="no value"):
        Quantiles().at(50)


def test_any_thread_may_read_while_one_adds():
    quantiles, over = Quantiles(), threading.Event()

    def read():
        while not over.is_set():
            told = quantiles.report(p50=50, p100=100)
            assert told["p50"] is None or 0.0 <= told["p50"] <= told["p100"]

    with ThreadPoolExecutor(1) as reader:
        reads = reader.submit(read)
        for n in range(12_000):
            quantiles.add(float(n % 7))
        over.set()
    assert reads.exception() is None and quantiles.at(50) == pytest.approx(3.0, rel=0.02)
