"""Programs on real sockets of this machine: fed, told, refused, and never able to hold anything up."""

import json
import logging
import socket
import struct
import threading
from contextlib import ExitStack, closing

import numpy as np
import pytest
from net_program import LENGTH, face_message, framed
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from sfms_robot.endpoint import origin_problem
from sfms_robot.errors import ConfigError, PacketError, PortError
from sfms_robot.frames import FRAME_S
from sfms_robot.sources import net_server
from sfms_robot.sources.net_messages import FACE, MICROPHONE, SPEECH, VOICE, json_message, sound_message
from sfms_robot.sources.net_person import SILENT_S, NetPerson, NetSight, NetSpeech, NetVoice, PageVisitor
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.registry import open_source

WAIT_S = 60.0  # for what is bound to come
SECOND = np.full(16000, 8000, np.int16)


class Run:
    """What a run opens, with a clock that the test sets; loop time 0 is 100 s."""

    def __init__(self, host="127.0.0.1"):
        self.now_s = 100.0
        self.person = NetPerson("--audio push", host, 0, lambda: self.now_s)
        self.voice, self.sight, self.speech = NetVoice(self.person), NetSight(self.person), NetSpeech(self.person)
        self.source = PairedSource(self.voice, self.sight, self.speech)
        self.source.start(100.0)

    def close(self):
        self.source.close()

    @property
    def told(self):
        return self.person.statistics()


@pytest.fixture
def run():
    with closing(Run()) as opened:
        yield opened


class Tcp:
    """A program on the other side."""

    def __init__(self, run, **hello):
        self.socket = socket.create_connection(("127.0.0.1", run.person.address[1]), WAIT_S)
        if hello:
            self.say(type="hello", **{"version": 1, **hello})

    def send(self, message):
        self.socket.sendall(framed(message))

    def say(self, **values):
        self.send(json_message(**values))

    def receive(self):
        """The next message; None: the robot has closed."""
        try:
            (length,) = LENGTH.unpack(self.exactly(LENGTH.size))
            return self.exactly(length)
        except (ConnectionError, EOFError):
            return None

    def exactly(self, count):
        data = b""
        while len(data) < count:
            if not (part := self.socket.recv(count - len(data))):
                raise EOFError
            data += part
        return data

    def close(self):
        self.socket.close()


class WebSocket:
    def __init__(self, run, origin=None, **hello):
        self.stack = ExitStack()
        address = f"ws://127.0.0.1:{run.person.address[1]}/"
        self.socket = self.stack.enter_context(connect(address, origin=origin, open_timeout=WAIT_S))
        if hello:
            self.say(type="hello", **{"version": 1, **hello})

    def send(self, message):
        self.socket.send(message)

    def say(self, **values):
        self.socket.send(json.dumps(values))

    def receive(self):
        try:
            message = self.socket.recv(WAIT_S)
        except ConnectionClosed:
            return None
        return message.encode() if isinstance(message, str) else message

    def close(self):
        self.stack.close()


BOTH = pytest.mark.parametrize("Program", [Tcp, WebSocket])


def joined(program):
    """Its welcome has come."""
    welcome = json.loads(program.receive())
    assert welcome["type"] == "welcome", welcome
    return program


def last_words(program):
    """Why the robot closes, which it does after everything that was sent before has been looked at."""
    words = None
    while (message := program.receive()) is not None:
        words = message
    program.close()
    return None if words is None else json.loads(words).get("error")


def looked_at(run, count):
    """So many messages have been."""
    for _ in range(20_000):
        if run.told["messages"] >= count:
            return
        threading.Event().wait(0.001)
    raise AssertionError(f"{run.told['messages']} of {count}")


def all_looked_at(program):
    program.say(type="hello", version=1)
    assert last_words(program) == "a second hello"


@BOTH
def test_what_a_program_feeds_comes_out_on_the_grid(run, Program):
    program = joined(Program(run, feeds=["voice", "face", "speech"]))
    program.send(sound_message(VOICE, 16000, 7.0, 7.0, SECOND))
    program.send(sound_message(SPEECH, 16000, 7.0, 7.2, SECOND[:1600]))
    program.send(face_message(7.0, 6.9, np.full(58, 0.25), 0.75))
    all_looked_at(program)
    seen = run.sight.at(-0.01)
    assert seen.attention == 0.75 and seen.face.time_s == pytest.approx(-0.1) and seen.face.blendshapes[0] == 0.25
    assert run.sight.at(0.0) is None  # who fed it has gone
    said = np.concatenate([run.speech.take(index) for index in range(10)])
    assert np.flatnonzero(said).tolist() == list(range(3200, 4800))


@BOTH
def test_a_voice_is_placed_by_the_senders_clock(run, Program):
    """Clicks half a second apart, by a clock of another origin, in pieces that come 0 to 60 ms late."""
    program, heard = joined(Program(run, feeds=["voice"])), []
    for index in range(60):
        piece = np.zeros(1600, np.int16)
        piece[:16] = 30_000 * (index % 5 == 0)
        run.now_s = 100.0 + (index + 1) * 0.1 + 0.03 * (index % 3)
        time_s = 5000.0 + (index + 1) * 0.1
        program.send(sound_message(VOICE, 16000, time_s, time_s, piece))
        looked_at(run, index + 2)
        heard += [frame for frame in run.source.read(run.now_s - 100.0)]
    all_looked_at(program)
    sound = np.concatenate([frame.audio if len(frame.audio) else np.zeros(640) for frame in heard])
    clicks = np.flatnonzero(np.diff((sound > 0.4).astype(int)) > 0)
    late = (clicks % 8000)[clicks > 24000]
    assert len(late) >= 4 and (np.minimum(late, 8000 - late) <= 16).all()


@BOTH
def test_programs_that_ask_are_told_what_is_heard_and_done(run, Program):
    run.person.tells("state", 0.0, state="idle", why=[])
    other = joined(Tcp(run, feeds=["face"]))  # asks for nothing, and is sent nothing
    program = joined(Program(run, wants=["microphone", "events"]))
    first = json.loads(program.receive())
    assert (first["type"], first["state"], first["at_s"]) == ("state", "idle", 100.0)
    run.now_s = 101.0
    run.person.hears(np.full(640, 0.5, np.float32), 0.04)
    run.person.tells("event", 1.2, event="nod", lasts_s=0.6, size=0.1)
    kind, version, _, rate_hz, sent_s, at_s = struct.unpack("<BBHIdd", (sound := program.receive())[:24])
    assert (kind, version, rate_hz, sent_s, at_s) == (MICROPHONE, 1, 16000, 101.0, pytest.approx(100.04))
    assert (np.frombuffer(sound[24:], "<i2") == 16384).sum() == 640
    nod = json.loads(program.receive())
    assert (nod["event"], nod["at_s"], nod["lasts_s"], nod["sent_s"]) == ("nod", 101.2, 0.6, 101.0)
    program.close()
    all_looked_at(other)


def test_a_part_that_was_closed_is_fed_no_more(run):
    program = joined(Tcp(run, feeds=["voice", "speech"]))
    run.speech.close()
    program.send(sound_message(SPEECH, 16000, 7.0, 0.0, SECOND))
    assert last_words(program) == "speech was not announced in its hello"


def test_a_second_feeder_is_refused_by_name_and_said_once(run, caplog):
    first = joined(Tcp(run, feeds=["voice", "speech"], name="booth"))
    port = first.socket.getsockname()[1]
    for _ in range(3):
        assert last_words(Tcp(run, feeds=["voice"])) == f"voice comes from booth (127.0.0.1:{port}) already"
    said = [record.message for record in caplog.records if "refused" in record.message]
    assert len(said) == 1 and "voice comes from booth" in said[0] and said[0].endswith("(said once)")
    assert run.told["refused"] == 3 and set(run.told["feeders"]) == {"voice", "speech"}
    all_looked_at(first)


def test_a_feeder_that_sends_no_voice_loses_its_place_but_one_that_does_not_speak_keeps_it(run):
    first = joined(Tcp(run, feeds=["voice", "speech"], name="booth"))
    run.now_s += SILENT_S + 0.01
    assert "speech comes from booth" in last_words(Tcp(run, feeds=["speech"]))
    second = joined(Tcp(run, feeds=["voice"], name="other"))
    assert last_words(first).startswith("voice now comes from other")
    second.send(sound_message(VOICE, 16000, 0, 0, SECOND[:640]))
    all_looked_at(second)
    assert run.told["messages"] > 0


def test_the_place_of_one_who_is_cut_off_is_free(run):
    first = joined(Tcp(run, feeds=["speech"]))
    first.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    first.close()  # a reset, as of a machine that is switched off
    for _ in range(1000):
        second = Tcp(run, feeds=["speech"])
        if json.loads(second.receive())["type"] == "welcome":
            break
        second.close()
    else:
        raise AssertionError("still taken")
    all_looked_at(second)


@BOTH
def test_malformed_messages_are_counted_and_said_once_the_next_is_read_and_too_many_close(run, Program, caplog):
    program = joined(Program(run, feeds=["speech"]))
    for _ in range(3):
        program.send(b"\x07 noise")
    program.send(sound_message(SPEECH, 16000, 0, 0, SECOND[:640]))
    looked_at(run, 5)
    assert run.told["malformed"] == 3
    assert len([record for record in caplog.records if "shorter than a header" in record.message]) == 1
    try:
        for _ in range(net_server.MOST_MALFORMED + 50):
            program.send(b"\x07 noise")
    except (ConnectionError, ConnectionClosed):
        pass
    last_words(program)
    assert run.told["malformed"] == net_server.MOST_MALFORMED + 1 and run.speech.take(1).any()


@BOTH
def test_each_wrong_message_is_answered_by_an_error_to_its_sender(run, Program):
    program = joined(Program(run, feeds=["voice"]))
    for data, said in (
        (SECOND[:480].tobytes(), "no header (raw PCM?)"),
        (b'{"type": "input_audio_buffer.append", "audio": "AAAA"}', "'input_audio_buffer.append' is an event of"),
        (SECOND[:480].tobytes(), "no header (raw PCM?)"),
    ):
        program.send(data)
        told = json.loads(program.receive())
        assert told["type"] == "error" and told["error"].startswith(said)
    for _ in range(5):
        program.send(sound_message(VOICE, 16000, 0, 0, SECOND))
    told = json.loads(program.receive())
    assert told["error"].startswith("voice left out: 1 s came faster than time passes")
    all_looked_at(program)
    assert (run.told["malformed"], run.told["too_fast"]) == (3, 3)


def test_a_program_whose_sound_comes_in_bursts_is_told_so_once(run):
    program = joined(Tcp(run, feeds=["voice"]))
    for number in range(40):
        run.now_s += 0.4
        for _ in range(4):
            program.send(sound_message(VOICE, 16000, 0, 0, SECOND[:1600]))
        looked_at(run, 4 * number + 5)
    assert json.loads(program.receive())["error"].startswith("sound comes in bursts, up to 400 ms apart")
    all_looked_at(program)


def test_a_sentence_in_one_message_is_said_and_one_that_is_too_long_is_sent_back(run):
    program = joined(WebSocket(run, feeds=["speech"]))
    program.send(sound_message(SPEECH, 24000, 0, 0, np.full(24000 * 20, 8000, np.int16)))
    program.send(sound_message(SPEECH, 24000, 0, 0, np.full(24000 * 22, 8000, np.int16)))
    assert json.loads(program.receive())["error"].endswith("more than 1048576: send it in pieces")
    all_looked_at(program)
    assert run.speech.take(490).all() and not run.speech.take(520).any()


def test_a_run_misses_whose_program_has_gone_but_not_a_silent_assistant(run):
    assert not run.voice.lost
    all_looked_at(joined(Tcp(run, feeds=["voice", "face", "speech"])))
    for _ in range(20_000):
        if not run.told["feeders"]:
            break
        threading.Event().wait(0.001)
    assert (run.voice.lost, run.sight.lost, run.speech.lost) == (True, True, False)
    program = joined(Tcp(run, feeds=["voice"]))
    assert (run.voice.lost, run.sight.lost) == (False, True)
    all_looked_at(program)


@pytest.mark.parametrize(
    ("hello", "sent", "words"),
    [
        ({"feeds": ["voice"]}, framed(sound_message(SPEECH, 16000, 0, 0, SECOND)), "speech was not announced in its"),
        ({}, framed(sound_message(SPEECH, 16000, 0, 0, SECOND)), "the first message must be a hello"),
        ({}, struct.pack("<I", 2**31), "a message of 2147483648 bytes"),
    ],
)
def test_a_message_that_was_not_announced_or_is_none_ends_the_connection(run, hello, sent, words):
    program = Tcp(run, **hello)
    if hello:
        joined(program)
    program.socket.sendall(sent)
    assert last_words(program).startswith(words)


def test_a_run_that_takes_only_speech_says_so():
    speech = open_source("none", "none", 1.0, agent_audio="tcp:0")
    with closing(speech):
        speech.start(0.0)
        (person,) = speech.outlets
        program = Tcp(type("Only", (), {"person": person}), feeds=["voice"])
        assert last_words(program) == "this run accepts no voice from programs (--audio push)"


@pytest.mark.parametrize("sent", [b"", b"GE", b"GET / HTTP/1.1\r\nHost: x\r\n"])
def test_a_caller_who_says_nothing_whole_is_closed(run, monkeypatch, sent):
    monkeypatch.setattr(net_server, "HELLO_S", 0.02)
    with socket.create_connection(run.person.address, WAIT_S) as silent:
        silent.sendall(sent)
        assert silent.recv(100) == b""
    assert run.told["refused"] == 1


@pytest.mark.parametrize("text", [b"\xff", [b'{"type":"hush', b'\xc3"}']])
def test_a_text_that_is_not_utf_8_ends_its_connection_with_code_1007(run, text, caplog):
    for _ in range(2):
        program = joined(WebSocket(run, feeds=["speech"]))
        program.socket.send(text, text=True)
        with pytest.raises(ConnectionClosed) as closed:
            program.socket.recv(WAIT_S)
        program.close()
        assert closed.value.rcvd.code == 1007
    assert len([record for record in caplog.records if "not UTF-8" in record.message]) == 1
    program = joined(WebSocket(run, feeds=["voice"]))
    program.socket.send([b'{"type": "hello", "version": 1, "name": "\xc3', b'\xa9"}'], text=True)
    assert last_words(program) == "a second hello"


def test_no_more_programs_than_there_is_room_for(run):
    with ExitStack() as stack:
        for _ in range(net_server.MOST_CONNECTIONS):
            stack.callback(joined(Tcp(run, wants=["events"])).close)
        assert last_words(Tcp(run, wants=["events"])) is None


def test_old_sound_and_faces_are_left_out(run):
    program = joined(Tcp(run, feeds=["voice", "face"]))
    program.send(sound_message(VOICE, 16000, 50.0, 50.0, SECOND[:640]))
    program.send(sound_message(VOICE, 16000, 50.0, 48.0, SECOND[:640]))
    program.send(face_message(50.0, 48.0, np.zeros(58)))
    all_looked_at(program)
    assert run.told["old"] == 2


def test_a_hush_ends_what_is_still_to_be_said(run):
    program = joined(Tcp(run, feeds=["speech"]))
    program.send(sound_message(SPEECH, 16000, 0, 0, SECOND))
    program.say(type="hush")
    all_looked_at(program)
    assert not any(run.speech.take(index).any() for index in range(30))


def test_a_reader_who_does_not_read_gets_the_newest_and_holds_nobody_up(run):
    program, rounds = joined(Tcp(run, wants=["microphone"])), 12_000
    for index in range(1, rounds + 1):
        run.person.hears(np.full(640, 0.25, np.float32), index * 0.04)
    got = []
    while not got or got[-1] < 100.0 + rounds * 0.04 - 1e-6:
        got.append(struct.unpack("<d", program.receive()[16:24])[0])
    assert got == sorted(got) and len(got) < rounds
    program.close()


def test_beyond_loopback_a_token_is_needed_and_is_new_at_every_start(run, caplog):
    assert run.person.token is None
    caplog.clear()
    with closing(Run("0.0.0.0")) as run, closing(Run("0.0.0.0")) as other:
        assert run.person.token != other.person.token and f"token {run.person.token}" in caplog.records[0].message
        for token in ("", "wrong", other.person.token):
            said = last_words(Tcp(run, feeds=["voice"], token=token))
            assert said == "the token is not the one that the robot printed when it started"
        all_looked_at(joined(WebSocket(run, wants=["microphone"], token=run.person.token)))


@pytest.mark.parametrize(
    ("origin", "admitted"),
    [
        ("http://localhost:3000", True),
        ("http://[::1]:8", True),
        (None, True),
        ("https://example.org", False),
        ("http://127.0.0.1.example.org", False),
        ("file://", False),
    ],
)
def test_only_pages_of_this_machine_may_connect(run, origin, admitted):
    if admitted:
        all_looked_at(joined(WebSocket(run, origin, wants=["events"])))
        return
    with pytest.raises(InvalidStatus) as refused:
        WebSocket(run, origin, wants=["events"])
    assert refused.value.response.status_code == 403
    assert run.told["malformed"] == 1


def test_a_name_that_was_bent_to_this_machine_proves_nothing():
    assert origin_problem("http://bent.example:8765", "bent.example:8765") is not None
    assert origin_problem("http://192.0.2.7:8000", "192.0.2.7:8765") is None


@pytest.mark.parametrize("count", [60, pytest.param(600, marks=pytest.mark.slow)])
def test_noise_on_the_wire_ends_that_connection_alone(run, count):
    rng = np.random.default_rng(count)
    shake = b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    shake += b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    for index in range(count):
        noise = rng.bytes(int(rng.integers(1, 4000)))
        with socket.create_connection(run.person.address, WAIT_S) as wire:
            wire.sendall([b"", b"GET ", shake, framed(json_message(type="hello", version=1))][index % 4] + noise)
            wire.shutdown(socket.SHUT_WR)
            try:
                while wire.recv(65536):
                    continue
            except ConnectionError:
                continue
    all_looked_at(joined(WebSocket(run, wants=["events"])))


def test_programs_are_told_when_the_run_ends():
    run = Run()
    program = joined(WebSocket(run, wants=["events"]))
    run.close()
    assert last_words(program) == "the robot stops"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(run.person.address, WAIT_S).close()


def test_flags_that_name_one_address_share_it_and_it_is_free_afterwards(caplog):
    caplog.set_level(logging.ERROR)
    with closing(open_source("push:0")) as source:  # ends before it began
        port = source.outlets[0].address[1]
    with closing(open_source(f"push:{port}", f"push:{port}", agent_audio=f"tcp:{port}")) as source:
        source.start(0.0)
        assert len(source.outlets) == 1 and source.outlets[0].address == ("127.0.0.1", port)
        with pytest.raises(PortError, match=f"--audio push: port {port} is used by another run of this program"):
            open_source(f"push:{port}")
    used = f"--agent-audio tcp: TCP port {port} on 127.0.0.1: is used by another program"
    with closing(socket.create_server(("127.0.0.1", port))), pytest.raises(PortError, match=used):
        open_source("none", agent_audio=f"tcp:{port}")
    assert not caplog.records


@pytest.mark.parametrize("place", ["70000", "x", ":5", "localhost:", "1.2.3.4"])
def test_an_address_that_is_none_is_refused_with_the_choices(place):
    with pytest.raises(ConfigError, match=r"expected a TCP port \(valid: --audio push, --audio push:PORT"):
        open_source(f"push:{place}")


PIECE = np.full(960, 8192, np.int16)  # 20 ms of a quarter of full scale


class Here:
    """A visitor with a clock that is set, of which the sender's is `ahead_s`."""

    def __init__(self):
        self.now_s = 1000.0
        self.visitor = PageVisitor(lambda: self.now_s)
        self.voice, self.sight = self.visitor.voice, self.visitor.sight

    def speaks(self, number, seconds, ahead_s=-990.0):
        for _ in range(round(seconds * 50)):
            self.now_s += 0.02
            at_s = self.now_s + ahead_s
            self.visitor.received(number, sound_message(VOICE, 48_000, at_s, at_s, PIECE))


def test_the_voices_of_visitors_come_in_frames_whatever_their_clocks():
    here = Here()
    here.visitor.came(7, ["voice"])
    here.voice.start(here.now_s)
    here.speaks(7, 0.4)
    frames = [here.voice.take(index) for index in range(8)]
    assert all(frame is not None and frame.shape == (640,) for frame in frames)
    assert np.allclose(frames[5], 0.25, atol=0.01) and not here.voice.lost
    here.visitor.gone(7)
    here.visitor.came(8, ["voice"])
    here.speaks(8, 1.0, ahead_s=+5000.0)
    assert here.visitor.statistics() == {"old": 0, "too_fast": 0}
    assert here.voice.take(round(1.2 / FRAME_S)) is not None


def test_a_visitors_face_comes_at_its_time_and_grows_old_when_none_follows():
    here = Here()
    here.visitor.came(7, ["face"])
    here.sight.start(here.now_s)
    here.visitor.received(7, face_message(5.0, 5.0, np.zeros(58)))
    here.visitor.received(7, face_message(5.1, 5.1, None))
    assert here.sight.at(1.0).face.time_s == pytest.approx(0.0, abs=0.11)


def test_what_a_visitor_did_not_announce_is_refused():
    visitor = Here().visitor
    sound, face = sound_message(VOICE, 48_000, 1.0, 1.0, PIECE), face_message(1.0, 1.0, np.zeros(58))
    for feeds, number, message, said in (
        ([], 7, sound, "voice was not announced by `source`"),
        (["voice"], 7, face, "face was not announced"),
        (["voice"], 8, sound, "voice was not announced"),
        (["voice"], 7, sound_message(SPEECH, 48_000, 1.0, 1.0, PIECE), "only voice and face"),
        (["voice"], 7, bytes([FACE]), "shorter than a header"),
    ):
        visitor.came(7, feeds)
        with pytest.raises(PacketError, match=said):
            visitor.received(number, message)


def test_a_visitor_who_has_gone_is_lost_until_another_comes():
    here = Here()
    assert open_source("browser", "browser", visitor=here.visitor).duration_s is None
    assert not here.voice.lost and not here.sight.lost  # no visitor yet: none is missed
    here.visitor.came(7, ["voice", "face"])
    here.visitor.gone(8)
    assert not here.voice.lost
    here.visitor.gone(7)
    assert here.voice.lost and here.sight.lost
    here.visitor.came(9, ["voice"])
    assert not here.voice.lost and here.sight.lost
