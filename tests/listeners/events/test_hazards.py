"""Hazards are the sum of their terms; a broken file is one line."""

import numpy as np
import pytest
import yaml

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import EVENT_KINDS
from sfms_robot.listeners.events.evidence import AT, EVIDENCE, NUMBERS
from sfms_robot.listeners.events.model import FILE, HazardBank, load_tables
from sfms_robot.signals.phase import piecewise_linear_basis

SHIPPED = data_dir("sim") / "listeners" / FILE


@pytest.fixture(scope="module")
def tables():
    return load_tables(SHIPPED)


def rows(seed, count=50):
    rng = np.random.default_rng(seed)
    values = rng.exponential(3.0, (count, len(EVIDENCE)))
    values[rng.random(values.shape) < 0.1] = np.nan
    values[rng.random(values.shape) < 0.1] = np.inf
    for name in NUMBERS:
        values[:, AT[name]] = rng.integers(2, size=count)
    return values


@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_log_odds_are_the_sum_of_curves_and_numbers(tables, kind):
    hazard, evidence = tables.hazards[kind], rows(1)
    bank = HazardBank({kind: hazard})
    expected = np.full(len(evidence), hazard.intercept)
    for name, weight in hazard.weights.items():
        value = evidence[:, AT[name]]
        if isinstance(weight, dict):
            expected += piecewise_linear_basis(value, tuple(weight)) @ np.array(list(weight.values()))
        else:
            expected += weight * np.nan_to_num(value)
    np.testing.assert_allclose(bank.log_odds(bank.contributions(evidence))[:, 0], expected, atol=1e-9)


def test_one_row_is_a_row_of_many_and_a_kind_is_a_kind_of_all(tables):
    bank, evidence = HazardBank(tables.hazards), rows(2)
    many = bank.log_odds(bank.contributions(evidence))
    for index in (0, 17, 49):
        np.testing.assert_array_equal(bank.log_odds(bank.contributions(evidence[index])), many[index])
    alone = HazardBank({"nod": tables.hazards["nod"]})
    np.testing.assert_allclose(
        alone.log_odds(alone.contributions(evidence))[:, 0], many[:, bank.kinds.index("nod")], atol=1e-12
    )


def test_what_does_not_apply_says_nothing_and_the_largest_terms_are_returned(tables):
    bank, nothing = HazardBank(tables.hazards), np.full(len(EVIDENCE), np.nan)
    assert not bank.contributions(nothing).any()
    np.testing.assert_allclose(
        bank.log_odds(bank.contributions(nothing)), [h.intercept for h in tables.hazards.values()]
    )
    bank, evidence = HazardBank(tables.hazards), rows(3)[0]
    told = bank.largest(bank.contributions(evidence), "nod")
    assert 1 <= len(told) <= 4 and set(told) <= set(tables.hazards["nod"].weights)
    assert list(np.abs(list(told.values()))) == sorted(np.abs(list(told.values())), reverse=True)


def broken(tmp_path, change):
    raw = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
    change(raw)
    file = tmp_path / "events.yaml"
    file.write_text(yaml.safe_dump(raw, sort_keys=False))
    return file


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda raw: raw["hazards"].pop("nod"), "hazards: nod is missing"),
        (lambda raw: raw["hazards"].update(wave=raw["hazards"]["nod"]), "wave is not a kind of event"),
        (lambda raw: raw["hazards"]["nod"]["weights"].update(mood=1.0), "weights.mood is not known evidence"),
        (lambda raw: raw["hazards"]["nod"]["weights"].update(silence_s=1.0), "silence_s needs values by knot"),
        (lambda raw: raw["hazards"]["nod"]["weights"].update(looked_at={0: 1, 1: 0}), "looked_at needs one number"),
        (lambda raw: raw["hazards"]["nod"]["weights"].update(silence_s={1: 1, 0: 0}), "knots have to rise"),
        (lambda raw: raw["hazards"]["nod"].update(intercept=float("nan")), "intercept"),
        (lambda raw: raw["shapes"]["nod"].update(duration_s=[2.0, 1.0]), "quantiles have to rise"),
        (lambda raw: raw.update(more=1), "'more' is not a known key"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path, change, problem):
    with pytest.raises(ConfigError, match=problem) as raised:
        load_tables(broken(tmp_path, change))
    assert "\n" not in str(raised.value) and "events.yaml" in str(raised.value)


def test_a_file_that_is_not_there_or_no_yaml_is_one_line(tmp_path):
    (tmp_path / "bad.yaml").write_text("a: [")
    for name in ("none.yaml", "bad.yaml"):
        with pytest.raises(ConfigError, match=name):
            load_tables(tmp_path / name)
