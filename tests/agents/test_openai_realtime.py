"""A head beside a realtime session, against a server on loopback that follows the documented events."""

import asyncio
import base64
import json
from contextlib import asynccontextmanager

import pytest
from noted import NOD, NotedRobot, Stopped
from websockets.asyncio.server import serve

import sfms_robot as sr
from sfms_robot.agents import events
from sfms_robot.agents.openai_realtime import DELTAS, RATE_HZ, RealtimeHead, converse

PIECE = bytes([1, 0]) * 2400  # 0.1 s
STARTED = {"type": "input_audio_buffer.speech_started", "audio_start_ms": 10, "item_id": "person"}


def delta(sound, kind=DELTAS[0], item="answer", **more):
    return {"type": kind, "item_id": item, "content_index": 0, "delta": base64.b64encode(sound).decode(), **more}


@pytest.mark.parametrize("kind", DELTAS)
def test_both_names_of_an_answers_sound_are_spoken(kind):
    head = RealtimeHead(robot := NotedRobot())
    assert head.received(delta(PIECE, kind)) == (PIECE, None)
    head.sent({"type": "input_audio_buffer.append", "audio": base64.b64encode(PIECE).decode()})
    head.sent({"type": "response.create"})
    assert robot.said == robot.heard == [(PIECE, RATE_HZ)]


def test_an_interruption_hushes_tells_what_was_played_and_drops_the_rest_of_the_answer():
    head = RealtimeHead(robot := NotedRobot(), clock := Stopped())
    for _ in range(20):
        head.received(delta(PIECE))
    clock.now_s += 0.73
    truncate = {"type": "conversation.item.truncate", "item_id": "answer", "content_index": 0, "audio_end_ms": 730}
    assert head.received(STARTED) == (b"", truncate) and robot.hushed == 1
    assert head.received(delta(PIECE)) == (b"", None)  # was on its way
    assert head.received(delta(PIECE, item="next")) == (PIECE, None) and len(robot.said) == 21
    clock.now_s += 5.0
    head.received(delta(PIECE * 10, item="next"))  # the rest of it comes late, and counts from then on
    clock.now_s += 0.25
    assert head.received(STARTED)[1]["audio_end_ms"] == 350
    assert head.received(STARTED) == (b"", None) and robot.hushed == 3  # nothing was being said


@pytest.mark.parametrize(
    ("event", "line"),
    [
        (delta(b"123"), "speech: expected base64 of 16-bit samples, got 3 bytes"),
        (delta(b"") | {"delta": "%%%"}, "speech: expected base64 of 16-bit samples, got '%%%'"),
        ({"type": DELTAS[1]}, "speech: expected base64 of 16-bit samples, got None"),
        ({"type": "error", "error": {"message": "No such voice."}}, "error: No such voice."),
        ({"type": "error"}, "error: None"),
    ],
)
def test_an_event_that_cannot_be_used_is_named_once(event, line, caplog):
    head = RealtimeHead(robot := NotedRobot())
    assert [head.received(event) for _ in range(3)] == [(b"", None)] * 3 and not robot.said
    assert [record.message for record in caplog.records] == [f"realtime: {line} (said once)"]


def test_a_robot_that_hears_another_source_is_named_and_the_agent_continues(caplog):
    head = RealtimeHead(sr.Robot("reachy_mini", audio="katie"))
    head.received(delta(PIECE))
    assert head.received(STARTED)[1] is not None and head.robot_link.refused == {"speech": 2}
    assert [record.message.split(";")[0] for record in caplog.records] == [
        f'realtime: speech: {what}() needs audio="push" or "mic"' for what in ("say", "hush")
    ]


@asynccontextmanager
async def served(talk, key=None):
    """Serve `talk(socket)` on loopback; yield the address."""

    def check(connection, request):
        if key is not None and request.headers.get("Authorization") != f"Bearer {key}":
            return connection.respond(401, "no")

    async with serve(talk, "127.0.0.1", 0, process_request=check) as server:
        yield f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}/v1/realtime?model=fake"


async def microphone(pieces):
    for each in pieces:
        yield each
    await asyncio.Event().wait()


def conversation(talk, robot, key=None, given="", pieces=(PIECE,), **more):
    async def whole():
        async with served(talk, key) as url:
            await converse(url, robot, microphone(pieces), key=given, **more)

    asyncio.run(asyncio.wait_for(whole(), 20))


def test_a_conversation_hears_speaks_and_is_interrupted():
    robot, got, played, stopped, seen = NotedRobot(), [], [], [], []

    async def talk(socket):
        got.extend([json.loads(await socket.recv()) for _ in range(2)])
        for event in (delta(PIECE * 50), STARTED):
            await socket.send(json.dumps(event))
        got.append(json.loads(await socket.recv()))
        await socket.send("{")

    conversation(
        talk, robot, "secret", "secret", session={"type": "realtime"},
        play=played.append, stop=lambda: stopped.append(True), seen=seen.append,
    )  # fmt: skip
    update, append, truncate = got
    assert update == {"type": "session.update", "session": {"type": "realtime"}}
    assert base64.b64decode(append["audio"]) == PIECE and append["type"] == "input_audio_buffer.append"
    assert truncate["type"] == "conversation.item.truncate" and 0 <= truncate["audio_end_ms"] < 5000
    assert robot.heard == [(PIECE, RATE_HZ)] and robot.said == [(PIECE * 50, RATE_HZ)] and robot.hushed == 1
    assert played == [PIECE * 50] and stopped == [True] and seen[-1] == STARTED


def test_a_microphone_that_fails_ends_the_conversation():
    async def microphone():
        yield b"odd"
        raise RuntimeError("unplugged")

    async def whole():
        async with served(lambda socket: socket.wait_closed()) as url:
            await converse(url, robot, microphone())

    robot = NotedRobot()
    with pytest.raises(RuntimeError, match="unplugged"):
        asyncio.run(asyncio.wait_for(whole(), 20))
    assert robot.heard == []


async def breaks_off(socket):
    await socket.close(1011, "overloaded")


async def vanishes(socket):
    socket.transport.abort()


@pytest.mark.parametrize(
    ("talk", "key", "line"),
    [
        (breaks_off, None, r"the server broke off: 1011 .* overloaded$"),
        (vanishes, None, r"the server broke off: without a reason$"),
        (breaks_off, "secret", r"HTTP 401: the key is refused$"),
    ],
)
def test_a_server_that_refuses_or_breaks_off_is_one_line(talk, key, line):
    with pytest.raises(sr.PortError, match=rf"^ws://127.0.0.1:\d+/v1/realtime: {line}"):
        conversation(talk, NotedRobot(), key, "wrong")


@pytest.mark.parametrize(
    ("url", "line"),
    [("127.0.0.1:1", "url: expected ws://"), (None, "url: expected ws://"), ("ws://127.0.0.1:1", "cannot connect")],
)
def test_an_address_without_a_server_is_one_line(url, line):
    with pytest.raises(sr.RobotError, match=line):
        asyncio.run(converse(url, NotedRobot(), microphone([])))


def test_events_come_in_the_event_loop_until_it_is_left():
    robot = NotedRobot()

    async def first():
        found = events(robot, "nod", "mm_hm")
        waiting = asyncio.create_task(anext(found))
        while len(robot.callbacks) < 2:
            await asyncio.sleep(0)
        await asyncio.to_thread(robot.decide, NOD)
        event = await waiting
        await found.aclose()
        return event

    assert asyncio.run(first()) == NOD
    robot.decide(NOD)  # the loop has ended: nothing happens
