"""Pools of processes: results in order, errors raised, one thread for each process."""

import os
import pickle
from pathlib import Path

import pytest

import sfms_robot
from sfms_robot.child_process import ONE_THREAD, messages, process_pool, start_child, take_pipes
from sfms_robot.errors import ConfigError
from sfms_robot.lab.evaluation.rollout import run_in_processes

# Not the environment alone: BLAS and OpenMP read it when they are loaded.
LOOSE = {name: "7" for name in ONE_THREAD}


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


def threads(task=0):
    """Return the thread settings of this process, and the threads that torch uses."""
    import torch

    return {name: os.environ.get(name) for name in ONE_THREAD}, torch.get_num_threads()


def send_threads():
    _, outgoing = take_pipes()
    with outgoing:
        pickle.dump(threads(), outgoing)


def test_a_process_of_a_pool_computes_with_one_thread(monkeypatch):
    for name, value in LOOSE.items():
        monkeypatch.setenv(name, value)
    with process_pool(1) as pool:
        assert pool.submit(threads).result() == (ONE_THREAD, 1)
    assert {name: os.environ[name] for name in LOOSE} == LOOSE


def test_a_child_computes_with_one_thread(monkeypatch):
    """Listeners, and the processes of `serve`."""
    for name, value in LOOSE.items():
        monkeypatch.setenv(name, value)
    monkeypatch.syspath_prepend(Path(__file__).parent)
    with start_child(f"{__name__}:send_threads") as child:
        assert next(messages(child.stdout)) == (ONE_THREAD, 1)


def test_a_worker_of_pytest_computes_with_one_thread():
    assert threads() == (ONE_THREAD, 1)


def test_every_pool_of_the_package_is_made_in_one_place():
    package = Path(sfms_robot.__file__).parent
    making = ("ProcessPoolExecutor(", "multiprocessing.Pool", "get_context(")
    users = [file.name for file in package.rglob("*.py") if any(word in file.read_text("utf-8") for word in making)]
    assert users == ["child_process.py"]
