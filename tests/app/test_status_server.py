"""The status document over HTTP: on loopback, whole, and a port that is taken is said in one line."""

import json
import socket
import threading
from contextlib import closing
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from sfms_robot.app.listen.status_server import AUTO, StatusServer
from sfms_robot.cli.main import main
from sfms_robot.errors import ConfigError, PortError


def test_the_document_is_served_as_it_is_at_that_moment() -> None:
    states = iter(["starting", "listening"])
    with closing(StatusServer("0")) as server:
        server.serve(lambda: {"state": next(states)})
        for state in ("starting", "listening"):
            with urlopen(server.url, timeout=5) as answer:
                assert answer.headers["Content-Type"] == "application/json"
                assert json.load(answer) == {"state": state}
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"{server.url}etc/passwd", timeout=5)


def test_another_document_takes_the_place_of_the_first() -> None:
    with closing(StatusServer("0")) as server:
        for state in ("starting", "listening"):
            server.serve(lambda state=state: {"state": state})
            with urlopen(server.url, timeout=5) as answer:
                assert json.load(answer) == {"state": state}


def test_who_does_not_wait_for_the_answer_is_nobodys_trouble(capfd) -> None:
    asked = threading.Event()

    def slow() -> dict[str, str]:
        asked.wait()
        return {"long": 10_000_000 * "x"}

    with closing(StatusServer("0")) as server:
        server.serve(slow)
        with socket.create_connection(("127.0.0.1", server.port)) as gone:
            gone.sendall(b"GET / HTTP/1.0\r\n\r\n")
        asked.set()
        with urlopen(server.url, timeout=60) as answer:  # served by another thread
            assert len(answer.read()) > 10_000_000
    assert capfd.readouterr().err == ""


def test_a_port_that_is_in_use_is_refused_in_one_line() -> None:
    with closing(StatusServer("0")) as server:
        with pytest.raises(PortError, match=f"^--status {server.port}: Address already in use .*$"):
            StatusServer(str(server.port))
    with closing(StatusServer(str(server.port))) as again:
        assert again.port == server.port


def test_without_a_port_the_next_that_is_free_is_taken() -> None:
    with closing(StatusServer(AUTO)) as first, closing(StatusServer(AUTO)) as second:
        assert second.port != first.port and str(second) == f"http://127.0.0.1:{second.port}/ (8775 is taken)"


@pytest.mark.parametrize("wanted", ["-1", "65536", "http", "", "١"])
def test_what_is_no_port_is_refused_in_one_line(wanted: str) -> None:
    with pytest.raises(ConfigError, match=r"is no TCP port \(0 to 65535"):
        StatusServer(wanted)


def test_a_port_in_use_is_found_before_a_listener_is_loaded(capsys, monkeypatch) -> None:
    def load(*_: object) -> None:
        raise AssertionError("a listener was loaded")

    monkeypatch.setattr("sfms_robot.app.listen.preflight.begin_listening", load)
    with closing(StatusServer("0")) as server, pytest.raises(SystemExit) as ended:
        main(["run", "--duration", "1", "--status", str(server.port)])
    assert ended.value.code == PortError.exit_code
    assert f"--status {server.port}: Address already in use" in capsys.readouterr().err
