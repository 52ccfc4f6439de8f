"""Tasks in several processes: results in order, errors raised."""

import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.lab.evaluation.rollout import run_in_processes


def squared(number):
    if number < 0:
        raise ConfigError(f"{number}: must be 0 or more")
    return number * number


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_results_come_in_the_order_of_the_tasks(jobs):
    assert run_in_processes(squared, [3, 1, 2], jobs, "numbers") == [9, 1, 4]


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_what_a_task_raises_is_raised(jobs):
    with pytest.raises(ConfigError, match="-1: must be 0 or more"):
        run_in_processes(squared, [3, -1, 2], jobs, "numbers")
