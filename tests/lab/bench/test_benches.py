"""The table of benches: every line of it can be measured, and options go where they mean something."""

import importlib
import inspect
import sys
from pathlib import Path
from types import ModuleType

import pytest
import tiny_arig_training
import torch
from torch.nn.functional import scaled_dot_product_attention

from sfms_robot.errors import BusError, ConfigError
from sfms_robot.lab import bench
from sfms_robot.lab.bench import BENCHES, Bench, measure_all, run_bench
from sfms_robot.lab.bench.measure import environment, row
from sfms_robot.lab.bench.operation_count import OperationCount
from sfms_robot.lab.learning import train_runs


def quiet(line: str) -> None:
    pass


@pytest.mark.parametrize("name", BENCHES)
def test_every_bench_is_a_function_that_takes_what_its_line_says(name):
    module, function = BENCHES[name].place.split(":")
    measure = getattr(importlib.import_module(f"{bench.__name__}.{module}"), function)
    taken = inspect.signature(measure).parameters
    assert set(BENCHES[name].takes) <= set(taken)
    needed = {key for key, one in taken.items() if one.default is one.empty}
    assert needed <= {"say"}, "a bench without options has to run"


@pytest.mark.slow
def test_a_training_step_is_timed_with_and_without_its_model():
    found = importlib.import_module("sfms_robot.lab.bench.train_bench").measure(quiet, steps=2)
    assert set(found.figures) == {"train.arig", "train.tokenizer", "train.listener"}
    assert all(0 < each["ratio"] < 1 for each in found.figures.values())


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("bus", {"hours": 5}, "--hours 5: only 'bench memory'"),
        ("all", {"torture": True}, "--torture True: only 'bench live'"),
    ],
)
def test_an_option_that_means_nothing_there_is_refused(name, given, said):
    with pytest.raises(ConfigError, match=said):
        run_bench(name, given, quiet)


def test_a_bench_that_fails_does_not_cost_the_others_their_rows(monkeypatch):
    def fails():
        raise BusError("no servo answers")

    module = ModuleType("of_the_test")
    module.fails, module.works = fails, lambda: {"one": row([1.0], [2.0], "ms", "somebody")}
    monkeypatch.setitem(sys.modules, f"{bench.__name__}.of_the_test", module)
    both = {"first": Bench("of_the_test:fails", "fails"), "second": Bench("of_the_test:works", "works")}
    told = measure_all(both, quiet)
    assert not told.passed and list(told.lines) == ["first: no servo answers"] and list(told.figures) == ["one"]


def test_a_folder_with_the_package_is_found_from_anywhere_and_one_without_it_refused(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"--against .*: no sfms_robot in it"):
        environment(tmp_path)
    (tmp_path / "other" / "sfms_robot").mkdir(parents=True)
    (tmp_path / "other" / "sfms_robot" / "__init__.py").write_text("")
    monkeypatch.chdir(tmp_path)
    assert environment(Path("other"))["PYTHONPATH"] == str(tmp_path / "other")


def test_a_layer_and_attention_cost_their_operations_and_gradients_as_many_again():
    layer = torch.nn.Linear(10, 20)
    with OperationCount() as count:
        layer(torch.randn(5, 10)).sum().backward()
    assert count.matrix == 2 * 5 * 10 * 20 * 2 and count.drawn == 50
    rows = torch.randn(2, 4, 16, 8)
    with OperationCount() as count:
        scaled_dot_product_attention(rows, rows, rows)
    assert count.matrix == 2 * (2 * 2 * 4 * 16 * 16 * 8) and count.bytes >= rows.numel() * 4 * 4


@pytest.mark.parametrize(("most_frames", "pieces"), [(1200, 1), (48, 2), (1, 4)])
def test_a_step_costs_the_same_however_small_the_pieces_that_are_made_of_it(monkeypatch, most_frames, pieces):
    """But for what is done once a piece: scaling the loss, sums of gradients."""
    monkeypatch.setattr(train_runs, "MOST_FRAMES", most_frames)
    (found,) = train_runs.dry_run(tiny_arig_training.settings())["stages"]
    monkeypatch.undo()
    (whole,) = train_runs.dry_run(tiny_arig_training.settings())["stages"]
    assert (found["pieces"], found["batch"], found["steps"]) == (pieces, 4, 6)
    assert found["operations"] == pytest.approx(whole["operations"], rel=0.1)
    assert found["drawn"] == pytest.approx(whole["drawn"], rel=0.1)
