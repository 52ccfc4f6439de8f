"""The doors in threads of working processes: documents on loopback; slow clients and strangers cost little."""

import json
import socket
import threading
from collections import defaultdict
from contextlib import ExitStack, closing
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

from sfms_robot.app.fleet import fleet_page
from sfms_robot.app.serve.service import metrics_server
from sfms_robot.viewer.web_server import AUTO, CONNECTION_S, MOST_CONNECTIONS, BriefConnection, status_server

LIMIT_S = 60.0  # for what is bound to come
REQUEST = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nAccept: text/plain\r\n\r\n"


class Fleet:
    """A fleet in which there is no head; keeps what was halted."""

    def __init__(self):
        self.halted = []

    def states(self):
        return []

    def follow(self, receive):
        pass

    def halt(self, heads, by):
        self.halted.append((heads, by))
        return [{"name": "hall", "done": "halt"}]


def figures():
    nothing = dict.fromkeys(("p50", "p99"))
    return defaultdict(lambda: None, listener="a", server="b", heads=3, delay_ms=nothing, batch_size=nothing)


@pytest.fixture(params=["status", "metrics", "fleet"])
def address(request):
    """One of the three servers; gives its URL."""
    if request.param == "status":
        server = status_server("0")
        server.begin(lambda: {"state": "idle"})
    elif request.param == "metrics":
        pytest.importorskip("prometheus_client")
        server = metrics_server("0")
        server.begin(figures)
    else:
        server = fleet_page(Fleet(), 0)
    with closing(server):
        yield server.url


def port_of(url):
    return int(url.split(":")[2].partition("/")[0])


def to_its_end(connection):
    """All that arrives until the other side closes."""
    received = b""
    try:
        while part := connection.recv(65536):
            received += part
    except ConnectionResetError:
        pass
    return received


def test_the_document_is_served_as_it_is_at_that_moment_and_another_may_take_its_place():
    states = iter(["starting", "listening"])
    with closing(status_server("0")) as server:
        server.begin(lambda: {"state": next(states)})
        for state in ("starting", "listening"):
            with urlopen(server.url, timeout=LIMIT_S) as answer:
                assert json.load(answer) == {"state": state}
        server.begin(lambda: {"state": "idle"})
        with urlopen(server.url + "status", timeout=LIMIT_S) as answer:
            assert answer.headers["Content-Type"] == "application/json" and json.load(answer) == {"state": "idle"}
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"{server.url}etc/passwd", timeout=LIMIT_S)


def test_a_client_that_does_not_wait_for_the_answer_holds_nothing_up(capfd):
    asked = threading.Event()

    def slow():
        asked.wait()
        return {"long": 10_000_000 * "x"}

    with closing(status_server("0")) as server:
        server.begin(slow)
        with socket.create_connection(("127.0.0.1", server.port)) as gone:
            gone.sendall(b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n")
        asked.set()
        with urlopen(server.url, timeout=LIMIT_S) as answer:
            assert len(answer.read()) > 10_000_000
    assert capfd.readouterr().err == ""


def test_without_a_port_the_next_that_is_free_is_taken():
    with closing(status_server(AUTO)) as first, closing(status_server(AUTO)) as second:
        assert second.port != first.port and second.note == " (8775 is taken)"
    with closing(status_server(str(first.port))) as again:
        assert again.port == first.port


@pytest.mark.parametrize(
    ("host", "code"),
    [("127.0.0.1", b"200"), ("localhost:1", b"200"), ("a.example", b"403"), ("a.example:8775", b"403"), ("", b"403")],
)
def test_a_client_that_calls_this_machine_by_a_strangers_name_is_not_answered(address, host, code):
    with socket.create_connection(("127.0.0.1", port_of(address)), LIMIT_S) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: %s\r\n\r\n" % host.encode())
        answer = to_its_end(client)
    assert answer.split()[1] == code and (code == b"200" or len(answer.partition(b"\r\n\r\n")[2]) < 60)


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({"Content-Type": "application/json"}, 200),
        ({"Content-Type": "application/json", "Origin": "http://127.0.0.1:1"}, 200),
        ({"Content-Type": "application/json", "Origin": "http://robots.example"}, 403),
        ({"Content-Type": "text/plain"}, 400),  # what any page may send
    ],
)
def test_pages_of_others_send_no_commands(headers, code):
    fleet = Fleet()
    with closing(fleet_page(fleet, 0)) as server:
        try:
            with urlopen(Request(f"{server.url}halt", b'{"heads": ["hall"]}', headers), timeout=LIMIT_S) as answer:
                found = answer.status
                assert json.load(answer) == {"answers": [{"name": "hall", "done": "halt"}]}
        except HTTPError as error:
            with error:
                found = error.code
    assert found == code and fleet.halted == ([(["hall"], "the fleet's page")] if code == 200 else [])


def test_the_metrics_are_those_of_that_moment():
    pytest.importorskip("prometheus_client")
    with closing(metrics_server("0")) as server:
        server.begin(figures)
        with urlopen(server.url, timeout=LIMIT_S) as answer:
            assert answer.headers["Content-Type"].startswith("text/plain")
            assert 'sfms_heads{listener="a",server="b"} 3.0' in answer.read().decode()


def test_beside_400_slow_clients_a_request_is_answered_and_few_stay_open(address):
    with ExitStack() as stack:
        place = ("127.0.0.1", port_of(address))
        slow = [stack.enter_context(socket.create_connection(place, LIMIT_S)) for _ in range(400)]
        for index, client in enumerate(slow):
            try:
                client.sendall(REQUEST[: index % len(REQUEST)])
            except ConnectionError:
                pass  # it had to make room already
        with urlopen(address, timeout=CONNECTION_S) as answer:
            assert answer.status == 200
        assert not b"".join(to_its_end(client) for client in slow[: 400 - MOST_CONNECTIONS])


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HT", REQUEST[:-2], b"POST /halt HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n{"]
)
def test_a_request_that_is_not_whole_in_time_ends_its_connection(sent, monkeypatch):
    monkeypatch.setattr(BriefConnection, "limit_s", CONNECTION_S / 100)
    with closing(fleet_page(Fleet(), 0)) as server:
        with socket.create_connection(("127.0.0.1", server.port), LIMIT_S) as client:
            client.sendall(sent)
            assert to_its_end(client) == b""
