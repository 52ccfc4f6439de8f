"""Software written for real servos, unmodified, on emulated ones: real time, their own ports, their own waiting."""

import pytest

from sfms_robot.emulator.launch import launch


@pytest.fixture
def plugged_in():
    """Start a chain that ends with the test: `plugged_in(servos, timing=..., faults=...)`."""
    chains = []

    def start(servos, **how):
        chains.append(launch(servos, **how))
        return chains[-1]

    yield start
    for chain in chains:
        chain.close()


@pytest.fixture
def again():
    """Ask until the answer is good: a servo needs time to move or start, and a busy computer may be late."""

    def ask(call, good, tries=100_000):
        for _ in range(tries):
            answer = call()
            if good(answer):
                return answer
        raise AssertionError(f"after {tries} tries still {answer!r}")

    return ask
