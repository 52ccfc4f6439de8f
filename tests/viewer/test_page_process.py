"""The page on real sockets of this machine, in its process: told, worked, refused, and holding nothing up."""

import gzip
import itertools
import json
import os
import queue
import signal
import socket
import struct
import threading
from contextlib import ExitStack, closing, contextmanager, suppress
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from sfms_robot.app.options import PAGE
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError, InputError, PortError
from sfms_robot.viewer.page_messages import pack_picture, rare_json
from sfms_robot.viewer.page_process import Address, PageProcess
from sfms_robot.viewer.page_server import PageServer
from sfms_robot.viewer.web_server import CONNECTION_S, STATIC, PromptConnection, web_server

WAIT_S = 60.0  # for what is bound to come
RARE = rare_json("listening", (), {}, None)
HELLO = {"version": 1, "head": "face28", "joints": [], "channels": []}


class Asked:
    """What visitors asked for, as it comes; "speaker" is refused."""

    def __init__(self):
        self.came = queue.Queue()

    def command(self, visitor, name, values):
        if name == "speaker":
            raise InputError("speaker 'x' is not there")
        self.came.put((name, values))

    def person(self, visitor, message):
        self.came.put(("person", message))

    def left(self, visitor):
        self.came.put(("left", visitor))

    def next(self):
        """What comes next; that somebody of an earlier test has gone may come at any time."""
        while (came := self.came.get(timeout=WAIT_S))[0] == "left":
            pass
        return came


@pytest.fixture(scope="module")
def process():
    with closing(PageProcess(Address(port=0))) as page:
        page.wait()
        yield page


RUNS = itertools.count()


@pytest.fixture
def page(process):
    """Behind which a run has begun."""
    asked = process.asked = Asked()
    process.answered_by(asked)
    number = next(RUNS)
    process.say("begin", **HELLO, seed=number)
    with visit(process) as visitor:  # until the page has begun to show this run
        while heard(visitor, "hello").get("seed") != number:
            pass
    return process


@contextmanager
def visit(page, **more):
    with connect(page.url.split("?")[0].replace("http", "ws", 1) + "ws", open_timeout=WAIT_S, **more) as visitor:
        yield visitor


def heard(visitor, kind=None):
    """The next message, or the next of a kind."""
    while True:
        told = json.loads(visitor.recv(timeout=WAIT_S))
        if kind is None or told["type"] == kind:
            return told


def says(visitor, command, **values):
    visitor.send(json.dumps({"type": command, **values}))


def picture(time_s):
    return pack_picture(time_s, np.zeros(58, np.float32), np.zeros(2), np.full(2, np.nan, np.float32), RARE)


def got(url, **headers):
    with urlopen(Request(url, headers=headers), timeout=WAIT_S) as answer:
        return answer.read(), answer.headers


def test_the_page_and_its_protocol_are_there(page):
    body, headers = got(page.url)
    assert b"<!doctype html>" in body and headers["X-Content-Type-Options"] == "nosniff"
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    with visit(page) as visitor:
        hello = heard(visitor)
        assert hello["type"] == "hello" and hello["head"] == "face28" and hello["controls"] == "nobody"
        assert (hello["over"], hello["needs_token"], hello["record"]) == (False, False, None)
        says(visitor, "ping", id=[1, "x"])
        assert heard(visitor) == {"type": "pong", "id": [1, "x"]}


def code_of(url, **headers):
    """The status of a request that is not answered with a file."""
    with pytest.raises(HTTPError) as refused:
        got(url, **headers)
    with refused.value:
        return refused.value.code


@pytest.mark.parametrize(
    ("name", "kind", "begins", "least"),
    [
        ("static/chunk.js", "javascript", b"", 3),
        ("static/vision/vision_wasm_internal.wasm", "application/wasm", b"\0asm", 2),  # stored packed
        ("human/head.bin", "application/octet-stream", b"", 1),
        ("", "text/html", b"<!doctype html>", 1),
    ],
)
def test_files_come_compressed_to_a_client_that_takes_it_and_once(page, name, kind, begins, least):
    url = page.url + name
    plain, headers = got(url)
    packed, other = got(url, **{"Accept-Encoding": "gzip, br"})
    assert plain.startswith(begins) and kind in headers["Content-Type"] and "Content-Encoding" not in headers
    assert other["Content-Encoding"] == "gzip" and gzip.decompress(packed) == plain and len(packed) < len(plain) / least
    assert other["Vary"] == "Accept-Encoding" and other["ETag"] == headers["ETag"]
    assert int(headers["Content-Length"]) == len(plain)
    assert code_of(url, **{"If-None-Match": headers["ETag"]}) == 304


def test_a_part_of_a_file_comes_plain_and_files_that_are_not_there_are_not_found(page):
    part, _ = got(page.url + "static/chunk.js", **{"Accept-Encoding": "gzip", "Range": "bytes=0-9"})
    assert part == (STATIC / "chunk.js").read_bytes()[:10]
    for path in ("recording", "robot/robot.urdf", "etc/passwd", "static/../page_server.py"):
        assert code_of(page.url + path) == 404


def test_pictures_go_to_all_and_come_back_in_the_last_run(page):
    with ExitStack() as stack:
        visitors = [stack.enter_context(visit(page)) for _ in range(10)]
        assert all(heard(visitor)["type"] == "hello" for visitor in visitors)
        page.show(picture(1.0))
        assert all(heard(visitor, "frame")["t"] == 1.0 for visitor in visitors)
        page.say("event", event="nod", at_s=1.2)
        page.say("status", status={"state": "listening"})
        report = {"exit": "failed", "torque_unconfirmed": ["neck_yaw"]}
        page.say("end", report=report)
        for visitor in visitors:
            assert heard(visitor) == {"type": "event", "event": "nod", "at_s": 1.2}
            assert heard(visitor) == {"type": "status", "status": {"state": "listening"}}
            assert heard(visitor) == {"type": "over", "report": report}
    with visit(page) as late:
        hello = heard(late)
        assert (hello["over"], hello["torque_unconfirmed"]) == (True, ["neck_yaw"])
    lines = [json.loads(line) for line in got(page.url + "runs/last")[0].splitlines()]
    assert [line["type"] for line in lines] == ["hello", "frame", "event", "over"] and lines[0]["replay"] is True


def test_another_run_begins_behind_the_same_page(page):
    with visit(page) as visitor:
        assert heard(visitor)["type"] == "hello"
        page.show(picture(5.0))
        assert heard(visitor, "frame")["t"] == 5.0
        page.say("begin", **{**HELLO, "head": "op3_head"})
        assert heard(visitor, "hello")["head"] == "op3_head"
    assert len(got(page.url + "runs/last")[0].splitlines()) == 1


def test_commands_reach_the_run_and_what_it_refuses_is_told_to_who_asked(page):
    with visit(page) as visitor, visit(page) as other:
        says(visitor, "show", channels={"jawOpen": 0.5})
        assert page.asked.next() == ("show", {"channels": {"jawOpen": 0.5}, "seconds": 0.5})
        assert heard(visitor, "controls")["held"] == "you" and heard(other, "controls")["held"] == "other"
        says(visitor, "speaker", name="x")
        assert heard(visitor, "error")["error"] == "speaker 'x' is not there"
        says(other, "halt")  # needs no controls, and takes none
        assert page.asked.next() == ("halt", {})
        says(other, "neutral")
        assert heard(other, "error")["error"] == "another visitor holds the controls"


def test_of_nobody_but_the_holder_voice_and_face_are_taken(page):
    message = struct.pack("<BBHIdd", 1, 1, 0, 16000, 1.0, 1.0) + bytes(640)
    with visit(page) as visitor, visit(page) as other:
        says(visitor, "source", feeds=["voice"])
        assert page.asked.next() == ("source", {"feeds": ["voice"]})
        visitor.send(message)
        assert page.asked.next() == ("person", message)
        other.send(message)
        assert "from the holder of the controls" in heard(other, "error")["error"]
        holder = page.asked.came
    assert holder.get(timeout=WAIT_S)[0] == "left"


def test_nonsense_is_refused_in_a_line_and_the_visitor_stays(page):
    with visit(page) as visitor:
        for text in ("", "[]", '{"type":"show"}', "9" * 9000):
            visitor.send(text)
            assert "\n" not in heard(visitor, "error")["error"]
        says(visitor, "ping", id=1)
        assert heard(visitor, "pong") == {"type": "pong", "id": 1}


@pytest.mark.parametrize("messages", [["nonsense"] * 300, [bytes(300_000)]])
def test_too_much_nonsense_and_a_message_that_is_too_long_end_the_connection(page, messages):
    with visit(page) as visitor, pytest.raises(ConnectionClosed):
        for message in messages:
            visitor.send(message)
        while True:
            visitor.recv(timeout=WAIT_S)
    with visit(page) as another:
        assert heard(another)["type"] == "hello"


@pytest.mark.parametrize("text", [b"\xff", b'{"type":"ping","id":"\xc3"}', [b"\xc3", b"("]])
def test_a_text_that_is_not_utf_8_ends_its_connection_with_code_1007_and_without_a_word(capfd, text):
    with closing(PageProcess(Address(port=0))) as page:
        page.wait()
        page.say("begin", **HELLO)
        with visit(page) as visitor, pytest.raises(ConnectionClosed) as closed:
            visitor.send(text, text=True)
            while True:
                visitor.recv(timeout=WAIT_S)
        with visit(page) as other:
            other.send([b'{"type":"ping","id":"\xc3', b'\xa9"}'], text=True)  # whole in the end
            assert heard(other, "pong")["id"] == "\xe9"
    assert closed.value.rcvd.code == 1007
    assert capfd.readouterr().err == ""


HALF_OPEN = (
    b"",
    b"GET",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
    b"GET /ws HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n",
    b"GET /etc HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET / HTTP/1.1\r\nHo",  # a whole one first
    b"GET /etc HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n12",
)


def test_half_open_requests_are_ended_in_time_and_others_are_answered_meanwhile():
    class Prompt(PromptConnection):
        limit_s = CONNECTION_S / 20

    server = web_server(PageServer(lambda *_: None, None).app, Prompt, ws="websockets-sansio")
    listening = socket.create_server(("127.0.0.1", 0), backlog=200)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    place = listening.getsockname()
    try:
        with ExitStack() as stack:
            visitor = stack.enter_context(connect(f"ws://127.0.0.1:{place[1]}/ws", open_timeout=WAIT_S))
            half_open = [stack.enter_context(socket.create_connection(place, WAIT_S)) for _ in range(150)]
            for index, client in enumerate(half_open):
                client.sendall(HALF_OPEN[index % len(HALF_OPEN)])
            assert b"<!doctype html>" in got(f"http://127.0.0.1:{place[1]}/")[0]
            for client in half_open:
                with suppress(ConnectionResetError):
                    while client.recv(4096):
                        pass
            assert visitor.ping().wait(WAIT_S)  # whose request was whole
    finally:
        server.should_exit = True
        thread.join(WAIT_S)


@pytest.mark.parametrize("origin", ["http://robots.example", "http://192.0.2.7", "null", "file://"])
def test_pages_of_others_may_not_connect(page, origin):
    with pytest.raises(InvalidStatus, match="403"), visit(page, origin=origin):
        pass


def test_of_what_a_urdf_names_only_meshes_of_the_heads_folder_are_served(tmp_path):
    """A head's folder is data that people pass on. `kept`: a folder that the command line names."""
    head, kept, other = (tmp_path / name for name in ("head", "kept", "other"))
    for folder in (head, kept, other):
        folder.mkdir()
        (folder / "a.stl").write_text("solid a\nendsolid")
    (head / "link.stl").symlink_to(other / "a.stl")
    (head / "texture.png").write_bytes(b"not a mesh")
    served = {"a.stl": 200, "link.stl": 404, f"{kept}/a.stl": 200}
    served |= dict.fromkeys(["/etc/passwd", "../other/a.stl", f"file://{other}/a.stl", "texture.png"], 404)
    visuals = "".join(f'<visual><geometry><mesh filename="{name}"/></geometry></visual>' for name in served)
    robot = (data_dir("sim") / "heads" / "op3_head" / "robot.urdf").read_text()
    (head / "robot.urdf").write_text(robot.replace("</link>", f"{visuals}</link>", 1))
    text = (data_dir("configs") / "heads" / "op3_head" / "head.yaml").read_text()
    (head / "head.yaml").write_text(f"{text}\nurdf: robot.urdf\n")
    with closing(PageProcess(Address(port=0), PAGE)) as page:
        page.wait()
        page.say("begin", **HELLO, scene=str(head), packages=[str(kept)])
        with visit(page) as visitor:
            assert heard(visitor, "hello")["urdf"] == "robot/robot.urdf"
        codes = {}
        for name in [*served, "head.yaml", "%2e%2e/other/a.stl"]:
            try:
                codes[name] = 200 if got(page.url + "robot/" + name)[0] else 0
            except HTTPError as error:
                with error:
                    codes[name] = error.code
    assert codes == served | {"head.yaml": 404, "%2e%2e/other/a.stl": 404}


def test_a_recording_is_downloaded(page, tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"recorded")
    with visit(page) as visitor:
        page.say("recorded", file=str(tmp_path / "run.mcap"), record={"on": False, "seconds": 2})
        assert heard(visitor, "record") == {"type": "record", "on": False, "seconds": 2}
    body, headers = got(page.url + "recording")
    assert body == b"recorded" and 'filename="run.mcap"' in headers["Content-Disposition"]
    page.say("recorded", file=None, record=None)


def test_a_port_that_is_taken_makes_room_for_the_next(page):
    taken = int(page.url.rstrip("/").rpartition(":")[2])
    with closing(PageProcess(Address(port=taken))) as second:
        second.wait()
        assert second.taken == taken and f"({taken} is taken)" in str(second) and second.url != page.url


def test_beyond_loopback_a_token_is_made_and_asked_for(tmp_path):
    with closing(PageProcess(Address("0.0.0.0", 0))) as page:
        page.wait()
        asked = Asked()
        page.answered_by(asked)
        page.say("begin", **HELLO)
        (tmp_path / "run.mcap").write_bytes(b"recorded")
        page.say("recorded", file=str(tmp_path / "run.mcap"), record=None)
        assert (token := page.url.partition("/?token=")[2])
        port = int(page.url.split(":")[2].partition("/")[0])
        with connect(f"ws://127.0.0.1:{port}/ws") as visitor:
            assert heard(visitor)["needs_token"] is True
            says(visitor, "halt")
            assert "the token is needed" in heard(visitor, "error")["error"]
            says(visitor, "hello", version=1, token="guess")
            assert "is not the one" in heard(visitor, "error")["error"]
            says(visitor, "hello", version=1, token=token)
            assert heard(visitor)["type"] == "controls"
            says(visitor, "halt")
            assert asked.next() == ("halt", {})
        assert code_of(f"http://127.0.0.1:{port}/recording") == 403
        assert got(f"http://127.0.0.1:{port}/recording?token={token}")[0] == b"recorded"


def test_an_address_that_is_not_this_machines_is_refused_in_one_line():
    with (
        closing(PageProcess(Address("192.0.2.1", 8780))) as page,
        pytest.raises(PortError, match="^--view: .*192.0.2.1: "),
    ):
        page.wait()


def test_https_needs_a_certificate_and_its_key(tmp_path):
    (tmp_path / "a.pem").write_text("nothing")
    with pytest.raises(ConfigError, match="^--view-key .*: no such file"):
        Address.parsed("auto", tmp_path / "a.pem", tmp_path / "b.pem")
    address = Address.parsed("0", tmp_path / "a.pem", tmp_path / "a.pem")
    with closing(PageProcess(address)) as page, pytest.raises(ConfigError, match="not a certificate with its key"):
        page.wait()


def test_a_page_whose_process_dies_takes_no_run_with_it(caplog):
    with closing(PageProcess(Address(port=0))) as page:
        page.wait()
        os.kill(page.process_id, signal.SIGKILL)
        for _ in range(100):
            page.show(picture(1.0))
            page.say("status", status={})
        page._supervised.child.reader.join(WAIT_S)
        assert page.visitors == 0 and "page: its process died" in caplog.text
