"""`--port FAMILY=DEVICE[,MODEL:IDS[@BAUD]]` runs the contract of the servo buses on real servos."""

import os
import sys

from sfms_robot.child_process import ONE_THREAD

os.environ.update(ONE_THREAD)  # before numpy and torch are loaded, here and in the workers that pytest starts

import pytest
from ended import Ended
from sound_server import SoundServer

from sfms_robot.cli.main import main


@pytest.fixture(scope="session", autouse=True)
def _no_overlays_of_whoever_runs_the_tests(tmp_path_factory):
    """Shipped heads are what is tested, not the build on this desk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield


def pytest_addoption(parser):
    parser.addoption(
        "--port",
        action="append",
        default=[],
        metavar="FAMILY=DEVICE[,MODEL:IDS[@BAUD]]",
        help="run hardware tests of this family on real servos: dynamixel2=/dev/ttyUSB0,xl330-m288:1-2@57600",
    )


def pytest_collection_modifyitems(config, items):
    if config.getoption("--port"):
        return
    skip = pytest.mark.skip(reason="needs real servos: --port FAMILY=DEVICE")
    for item in items:
        if "hardware" in item.keywords:
            item.add_marker(skip)


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
