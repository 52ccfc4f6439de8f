"""Options, profiles and fixtures of all tests.

`--port FAMILY=DEVICE[,MODEL:IDS[@BAUD]]` runs the contract of the servo buses on real servos.
`--all-tools` fails a run in which a test was skipped for a missing program or package.
`--hypothesis-profile thorough` draws 100 examples of each property, with a new seed, in place of 20 fixed ones.
"""

import os
import sys

from sfms_robot.processes import ONE_THREAD

os.environ.update(ONE_THREAD)  # before numpy and torch are loaded, here and in the workers that pytest starts

import pytest
from ended import Ended
from hypothesis import settings
from ros2_graph import client, free_endpoint, serving

from sfms_robot.cli.main import main
from sfms_robot.data import head_names
from sfms_robot.emulator.sound_server import SoundServer

# A busy computer is not a failure: no deadlines.
settings.register_profile("quick", max_examples=20, deadline=None, derandomize=True)
settings.register_profile("thorough", max_examples=100, deadline=None, print_blob=True)
settings.load_profile("quick")

EVERY_RUN = {"face28", "reachy_mini"}  # heads of `make test`; tests of the others are marked slow
ALIKE = {"dynamixel1-mx", "scs", "maestro-crc"}  # families much like one that every run tests: slow too
MISSING = ("needs ", "could not import ")  # reasons to skip that a complete machine does not have


@pytest.fixture(scope="session", autouse=True)
def _no_overlays(tmp_path_factory):
    """Test the shipped heads, without the overlays of this user."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield


def pytest_addoption(parser):
    parser.addoption("--all-tools", action="store_true", help="fail where a test was skipped for a missing tool")
    parser.addoption(
        "--port",
        action="append",
        default=[],
        metavar="FAMILY=DEVICE[,MODEL:IDS[@BAUD]]",
        help="run hardware tests of this family on real servos: dynamixel2=/dev/ttyUSB0,xl330-m288:1-2@57600",
    )


def pytest_collection_modifyitems(config, items):
    skip = pytest.mark.skip(reason="real servos: --port FAMILY=DEVICE")
    left_out = set(head_names()) - EVERY_RUN | ALIKE
    for item in items:
        if "hardware" in item.keywords and not config.getoption("--port"):
            item.add_marker(skip)
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if any(isinstance(value, str) and value.split(",")[0] in left_out for value in parameters):
            item.add_marker("slow")


def pytest_sessionfinish(session):
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if not session.config.getoption("--all-tools") or reporter is None:
        return
    reasons = [skipped.longrepr[2].removeprefix("Skipped: ") for skipped in reporter.stats.get("skipped", ())]
    if missing := sorted({reason for reason in reasons if reason.startswith(MISSING)}):
        reporter.write_line(f"--all-tools: {'; '.join(missing)}", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture
def router(tmp_path):
    """Return a router of zenoh that runs, as a graph of ROS 2 has one."""
    pytest.importorskip("zenoh", reason="needs the extra [ros2]")
    endpoint = free_endpoint()
    with serving(endpoint):
        yield client(tmp_path, endpoint)


@pytest.fixture(scope="session")
def _sound_servers(tmp_path_factory):
    if missing := SoundServer.missing():
        pytest.skip(f"needs a sound server: {missing}")
    return SoundServer(tmp_path_factory.mktemp("sound"))


@pytest.fixture
def sound_server(_sound_servers, monkeypatch):
    """A sound server with the sink `person`, whose monitor is the only microphone of this process."""
    for name, value in _sound_servers.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("PULSE_SERVER", raising=False)
    _sound_servers.start("person")
    if portaudio := sys.modules.get("sounddevice"):  # it sees the devices that were there when it was loaded
        portaudio._terminate()
        portaudio._initialize()
    yield _sound_servers
    _sound_servers.stop()


@pytest.fixture
def command_line(capsys):
    """Run `sfms-robot ARGUMENTS` in this process."""

    def run(*words: object) -> Ended:
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in words])
        return Ended(int(ended.value.code or 0), *capsys.readouterr())

    return run
