"""`--port FAMILY=DEVICE[,MODEL:IDS[@BAUD]]` runs the contract of the servo buses on real servos."""

import pytest


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
