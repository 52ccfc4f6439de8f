import signal

import pytest
from drill_rig import HEAD, servos

from sfms_robot.data import data_dir


@pytest.fixture(scope="session", autouse=True)
def hangups_are_heeded():
    """Also where these tests run under nohup, which what they start would inherit."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def device(tmp_path):
    return tmp_path / "servos"


@pytest.fixture
def chain(device):
    with servos(device) as running:
        yield running


@pytest.fixture(scope="session")
def slow_head(tmp_path_factory):
    """The head, with a second between two servos whose torque comes on."""
    folder = tmp_path_factory.mktemp("heads") / HEAD
    folder.mkdir()
    text = (data_dir("configs") / "heads" / HEAD / "head.yaml").read_text()
    slow = text.replace("rate_hz: 100}", "rate_hz: 100, stagger_ms: 1000}")
    assert slow != text
    (folder / "head.yaml").write_text(slow)
    return folder
