"""What a page costs, from windows with clients and without by turns."""

import pytest

from sfms_robot.lab.bench.view_bench import Window, cost_figures


def windows(run_shares, page_share=1.5, telling_share=0.25, late=()):
    """By turns, the first without clients."""
    return [
        Window(
            run_share=share,
            telling_share=telling_share * (number % 2),
            page_share=page_share * (number % 2),
            late=late[number] if late else 0,
        )
        for number, share in enumerate(run_shares)
    ]


def test_a_window_with_clients_is_laid_beside_its_neighbours_so_that_a_drift_costs_nothing():
    assert cost_figures(windows([20.0, 21.0 + 0.5, 22.0, 23.0 + 0.5, 24.0]))["run_apart"]["median"] == 0.5


def test_one_window_in_which_something_else_ran_changes_nothing():
    figures = cost_figures(windows([20.0, 20.5, 20.0, 35.0, 20.0, 20.5, 20.0]))
    assert figures["run_apart"]["median"] == 0.5 and figures["run_apart"]["quartiles"][0] == 0.5
    assert (figures["cost"]["telling_share"], figures["cost"]["page_share"], figures["cost"]["share"]) == (
        0.25,
        1.5,
        1.75,
    )


def test_late_ticks_are_counted_over_as_many_windows_of_each_kind():
    figures = cost_figures(windows([20.0] * 5, late=[9, 1, 2, 0, 4]))
    assert figures["late_ticks"] == {"without": 6, "with": 1}
    assert figures["view.cpu"]["repeats"] == 2 and figures["view.cpu"]["ratio"] == pytest.approx(21.5 / 20.0)
