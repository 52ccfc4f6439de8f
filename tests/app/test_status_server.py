"""The status document over HTTP: on loopback, whole, and a port that is taken is said in one line."""

import json
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from sfms_robot.app.listen.status_server import status_server
from sfms_robot.errors import PortError


def test_the_document_is_served_as_it_is_at_that_moment() -> None:
    states = iter(["starting", "listening"])
    with status_server(0, lambda: {"state": next(states)}) as port:
        for state in ("starting", "listening"):
            with urlopen(f"http://127.0.0.1:{port}/", timeout=5) as answer:
                assert answer.headers["Content-Type"] == "application/json"
                assert json.load(answer) == {"state": state}
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"http://127.0.0.1:{port}/etc/passwd", timeout=5)


def test_a_port_that_is_in_use_is_refused_in_one_line() -> None:
    with status_server(0, dict) as port, pytest.raises(PortError, match=f"--status {port}: Address already in use"):
        with status_server(port, dict):
            pass
