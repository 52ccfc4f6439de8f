"""The table of benches: every line of it can be measured, and options go where they mean something."""

import importlib
import inspect
import sys
from types import ModuleType

import pytest

from sfms_robot.errors import BusError, ConfigError
from sfms_robot.lab import bench
from sfms_robot.lab.bench import BENCHES, Bench, measure_all, performance_page, run_bench
from sfms_robot.lab.bench.compute_budget import Board
from sfms_robot.lab.bench.measure import Told, row


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


def test_a_bench_that_is_none_is_told_those_that_are():
    with pytest.raises(ConfigError, match=r'there is no "bos" \(all, startup, bus, .*fuzz'):
        run_bench("bos", {}, quiet)


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("bus", {"frames": 5}, "--frames 5: only 'bench retarget' takes it"),
        ("all", {"torture": True}, "--torture True: only 'bench live' takes it"),
        ("retarget", {"head": "face28"}, "takes a head with --frames"),
    ],
)
def test_an_option_that_means_nothing_there_is_refused(name, given, said):
    with pytest.raises(ConfigError, match=said):
        run_bench(name, given, quiet)


def test_a_page_has_every_row_and_says_where_it_was_measured(tmp_path):
    rows = Told.of_rows({"bus.tick": row([1.0, 2.0], [4.0], "ms", "somebody")}).figures
    performance_page.write(tmp_path / "page.md", {**rows, "notes": "no row"}, 1.5)
    page = (tmp_path / "page.md").read_text()
    assert "| bus.tick | 1.5 ms | 1.99 | 0.375 | somebody | 2 |" in page and "in 1.5 minutes" in page
    with pytest.raises(ConfigError, match="cannot be written"):
        performance_page.write(tmp_path / "nowhere" / "page.md", rows, 1.0)


def test_a_board_is_as_fast_as_the_slower_of_its_core_and_its_memory():
    board = Board(clock_ghz=1.0, per_cycle=4, memory_gb_s=2.0, call_us=10.0)
    assert board.ms(1e6, 0, 0) == pytest.approx(1.0) and board.ms(1e6, 4e6, 0) == pytest.approx(2.0)
    assert board.ms(0, 0, 100) == pytest.approx(1.0)


def test_a_row_says_how_often_against_what_and_on_which_machine():
    told = Told.of_rows({"one": row([1.0, 2.0, 3.0], [4.0], "ms", "somebody")})
    found = told.figures["one"]
    assert (found["median"], found["repeats"], found["ratio"]) == (2.0, 3, 0.5)
    assert "cores of" in found["machine"]
    assert told.table[0] | {"p99": None} == {
        "measured": "one", "median": 2.0, "unit": "ms", "p99": None, "ratio": 0.5, "to": "somebody",
    }  # fmt: skip


def test_a_bench_that_fails_does_not_cost_the_others_their_rows(monkeypatch):
    def fails():
        raise BusError("no servo answers")

    module = ModuleType("of_the_test")
    module.fails, module.works = fails, lambda: {"one": row([1.0], [2.0], "ms", "somebody")}
    monkeypatch.setitem(sys.modules, f"{bench.__name__}.of_the_test", module)
    both = {"first": Bench("of_the_test:fails", "fails"), "second": Bench("of_the_test:works", "works")}
    told = measure_all(both, quiet)
    assert not told.passed and list(told.lines) == ["first: no servo answers"] and list(told.figures) == ["one"]
