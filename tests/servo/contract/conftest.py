"""One rig per family: emulated servos that are put back between tests, or real ones (`--port`)."""

import pytest
from families import FAMILIES
from rig import emulated, real

from sfms_robot.emulator.launch import launch


def pytest_generate_tests(metafunc):
    if "rig" in metafunc.fixturenames:
        ports = metafunc.config.getoption("--port")
        for port in ports:
            if port.partition("=")[0] not in FAMILIES or "=" not in port:
                raise pytest.UsageError(f"--port {port}: is not FAMILY=DEVICE ({', '.join(FAMILIES)})")
        hardware = [pytest.param(port, marks=pytest.mark.hardware) for port in ports]
        needs_emulator = metafunc.definition.get_closest_marker("emulated") is not None
        metafunc.parametrize("rig", [*FAMILIES, *([] if needs_emulator else hardware)], indirect=True, scope="function")


@pytest.fixture(scope="session")
def chains():
    """Emulated servos by family, started when first asked for, and the time that each has reached."""
    running = {}
    yield running
    for chain, _ in running.values():
        chain.close()


@pytest.fixture
def rig(request, chains):
    name, _, rest = request.param.partition("=")
    if rest:
        device, _, servos = rest.partition(",")
        with real(name, device, servos) as rig:
            yield rig
        return
    family = FAMILIES[name]
    if name not in chains:
        chains[name] = launch(family.plugged(), virtual=True), 0.0
    chain, start_s = chains[name]
    for servo, ticks in zip(family.ids, family.start_ticks(), strict=True):
        chain.turn(servo, ticks)
    with emulated(name, chain=chain, start_s=start_s) as rig:
        yield rig
        put_back(chain, family.ids)
    chains[name] = chain, rig.now_s + 1.0


def put_back(chain, ids):
    """No faults, everybody there."""
    chain.clear_faults()
    chain.come_back()
    for servo in ids:
        chain.revive(servo)
