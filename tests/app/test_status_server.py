"""The small HTTP servers: the status document whole and on loopback; slow clients and strangers cost little."""

import json
import socket
import threading
from collections import defaultdict
from contextlib import ExitStack, closing
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from virtual_time import Time

from sfms_robot.app.fleet.fleet_client import fleet_page
from sfms_robot.app.loopback_server import AUTO, CONNECTION_S, MOST_CONNECTIONS, Answer, LoopbackServer, status_server
from sfms_robot.app.serve.service import metrics_server
from sfms_robot.cli.main import main
from sfms_robot.errors import ConfigError, PortError


def test_the_document_is_served_as_it_is_at_that_moment() -> None:
    states = iter(["starting", "listening"])
    with closing(status_server("0")) as server:
        server.begin(lambda: {"state": next(states)})
        for state in ("starting", "listening"):
            with urlopen(server.url, timeout=5) as answer:
                assert answer.headers["Content-Type"] == "application/json"
                assert json.load(answer) == {"state": state}
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"{server.url}etc/passwd", timeout=5)


def test_another_document_takes_the_place_of_the_first() -> None:
    with closing(status_server("0")) as server:
        for state in ("starting", "listening"):
            server.begin(lambda state=state: {"state": state})
            with urlopen(server.url, timeout=5) as answer:
                assert json.load(answer) == {"state": state}


def test_who_does_not_wait_for_the_answer_is_nobodys_trouble(capfd) -> None:
    asked = threading.Event()

    def slow() -> dict[str, str]:
        asked.wait()
        return {"long": 10_000_000 * "x"}

    with closing(status_server("0")) as server:
        server.begin(slow)
        with socket.create_connection(("127.0.0.1", server.port)) as gone:
            gone.sendall(b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n")
        asked.set()
        with urlopen(server.url, timeout=60) as answer:  # served by another thread
            assert len(answer.read()) > 10_000_000
    assert capfd.readouterr().err == ""


def test_a_port_that_is_in_use_is_refused_in_one_line() -> None:
    with closing(status_server("0")) as server:
        with pytest.raises(PortError, match=f"^--status {server.port}: Address already in use .*$"):
            status_server(str(server.port))
    with closing(status_server(str(server.port))) as again:
        assert again.port == server.port


def test_without_a_port_the_next_that_is_free_is_taken() -> None:
    with closing(status_server(AUTO)) as first, closing(status_server(AUTO)) as second:
        assert second.port != first.port and second.note == " (8775 is taken)"


@pytest.mark.parametrize("wanted", ["-1", "65536", "http", "", "١"])
def test_what_is_no_port_is_refused_in_one_line(wanted: str) -> None:
    with pytest.raises(ConfigError, match=r"is no TCP port \(0 to 65535"):
        status_server(wanted)


def test_a_port_in_use_is_found_before_a_listener_is_loaded(capsys, monkeypatch) -> None:
    def load(*_: object) -> None:
        raise AssertionError("a listener was loaded")

    monkeypatch.setattr("sfms_robot.app.options.begin_listening", load)
    with closing(status_server("0")) as server, pytest.raises(SystemExit) as ended:
        main(["run", "--duration", "1", "--status", str(server.port)])
    assert ended.value.code == PortError.exit_code
    assert f"--status {server.port}: Address already in use" in capsys.readouterr().err


LIMIT_S = 30.0  # for what is bound to come
REQUEST = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nAccept: text/plain\r\n\r\n"


def to_its_end(connection: socket.socket) -> bytes:
    """All that comes until the other side closes."""
    received = b""
    try:
        while part := connection.recv(65536):
            received += part
    except ConnectionResetError:
        pass
    return received


class NoHeads:
    """A fleet in which there is no head."""

    def states(self):
        return []

    def follow(self, told):
        pass


def figures():
    nothing = dict.fromkeys(("p50", "p99"))
    return defaultdict(lambda: None, listener="a", server="b", heads=3, delay_ms=nothing, batch_size=nothing)


@pytest.fixture(params=["status", "metrics", "fleet"])
def address(request):
    """One of the three servers; gives its URL."""
    with ExitStack() as stack:
        if request.param == "status":
            server = stack.enter_context(closing(status_server("0")))
            server.begin(lambda: {"state": "idle"})
        elif request.param == "metrics":
            pytest.importorskip("prometheus_client")
            server = stack.enter_context(closing(metrics_server("0")))
            server.begin(figures)
        else:
            server = stack.enter_context(closing(fleet_page(NoHeads(), 0)))
        yield server.url


@pytest.mark.parametrize(
    ("host", "code"),
    [
        ("127.0.0.1", b"200"),
        ("localhost:1", b"200"),
        ("robots.example", b"403"),
        ("robots.example:8775", b"403"),
        ("", b"403"),
    ],
)
def test_a_client_that_calls_this_machine_by_a_strangers_name_is_not_answered(address, host, code) -> None:
    port = int(address.split(":")[2].partition("/")[0])
    with socket.create_connection(("127.0.0.1", port), LIMIT_S) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: %s\r\n\r\n" % host.encode())
        answer = to_its_end(client)
    assert answer.split()[1] == code and (code == b"200" or len(answer.partition(b"\r\n\r\n")[2]) < 60)


def test_the_metrics_are_those_of_that_moment() -> None:
    pytest.importorskip("prometheus_client")
    with closing(metrics_server("0")) as server:
        server.begin(figures)
        with urlopen(server.url, timeout=LIMIT_S) as answer:
            assert answer.headers["Content-Type"].startswith("text/plain")
            assert 'sfms_heads{listener="a",server="b"} 3.0' in answer.read().decode()


def test_beside_400_slow_clients_a_request_is_answered_and_few_stay_open(address) -> None:
    port = int(address.split(":")[2].partition("/")[0])
    with ExitStack() as stack:
        slow = [stack.enter_context(socket.create_connection(("127.0.0.1", port), LIMIT_S)) for _ in range(400)]
        for index, client in enumerate(slow):
            try:
                client.sendall(REQUEST[: index % len(REQUEST)])
            except ConnectionError:
                pass  # it had to make room already
        with urlopen(address, timeout=CONNECTION_S) as answer:
            assert answer.status == 200
        assert not b"".join(to_its_end(client) for client in slow[: 400 - MOST_CONNECTIONS])


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HT", REQUEST[:-2], b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n{"]
)
def test_a_request_that_is_not_whole_in_time_ends_its_connection(sent) -> None:
    time = Time()

    class Reads(Answer):
        def do_POST(self):
            self.rfile.read(9)

    server = LoopbackServer(0, Reads, "test", now=time.now_s)
    server.begin()
    with closing(server), socket.create_connection(("127.0.0.1", server.port), LIMIT_S) as client:
        client.sendall(sent)
        with socket.create_connection(("127.0.0.1", server.port), LIMIT_S) as later:  # so that the first one is taken
            later.sendall(REQUEST)
            assert to_its_end(later)
        time.t = CONNECTION_S
        assert to_its_end(client) == b""
