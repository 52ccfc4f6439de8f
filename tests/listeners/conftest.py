import pytest
from tiny_sfms import tiny_listener

from sfms_robot.listeners.sfms.stream import SfmsListener


@pytest.fixture(scope="session")
def tiny() -> SfmsListener:
    return tiny_listener()
