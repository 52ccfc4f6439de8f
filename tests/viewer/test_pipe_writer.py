"""A pipe that is full holds nobody up, and nothing but old pictures is left out of it."""

import os
import threading

import pytest

from sfms_robot.viewer.page_process import PipeWriter

LIMIT_S = 30.0
LARGE = 1_000_000  # bytes: more than any pipe takes


@pytest.fixture
def ends():
    """A writer, and the end that is read from, open until the test is over."""
    reading, writing = os.pipe()
    writer = PipeWriter(os.fdopen(writing, "wb"))
    with os.fdopen(reading, "rb") as pipe:
        yield writer, pipe
        writer.close()


def test_messages_come_whole_and_in_order(ends):
    writer, pipe = ends
    writer.send(b"a" * LARGE)
    writer.send(b"b" * 10)
    writer.send_newest(b"c" * 10)
    writer.close()
    assert pipe.read() == b"a" * LARGE + b"b" * 10 + b"c" * 10


def test_of_pictures_that_a_full_pipe_cannot_take_the_newest_is_sent(ends):
    writer, pipe = ends
    pictures = [bytes([65 + index]) * 40_000 for index in range(20)]
    for picture in pictures:
        writer.send_newest(picture)  # nobody reads yet
    writer.close()
    came = pipe.read()
    assert len(came) % 40_000 == 0
    shown = [came[at : at + 40_000] for at in range(0, len(came), 40_000)]
    assert shown[0] == pictures[0] and shown[-1] == pictures[-1] and len(shown) < len(pictures)
    assert shown == [picture for picture in pictures if picture in shown]


def test_tasks_are_done_by_a_thread_and_may_send(ends):
    writer, pipe = ends
    done = []
    writer.later(lambda: (done.append(threading.current_thread()), writer.send(b"told")))
    assert pipe.read(4) == b"told" and done[0] is not threading.current_thread()


def test_a_reader_that_has_gone_costs_nothing():
    reading, writing = os.pipe()
    writer = PipeWriter(os.fdopen(writing, "wb"))
    os.close(reading)
    for _ in range(3):
        writer.send_newest(b"picture")
        writer.send(b"message")
    writer.close()
