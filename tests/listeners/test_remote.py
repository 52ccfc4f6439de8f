"""The listener's own process: what it hears when it cannot keep up."""

import multiprocessing
import queue

import numpy as np
import pytest

from sfms_robot.frames import FRAME_S, Plan, SpeakerFrame
from sfms_robot.listeners.process import MOST_WAITING, Inbox, listen


def frames(count):
    return [SpeakerFrame(i * FRAME_S, None, None) for i in range(count)]


def filled(items):
    inbox = queue.Queue()
    for item in items:
        inbox.put(item)
    return inbox


@pytest.mark.parametrize("count", [1, 2, MOST_WAITING])
def test_frames_come_in_their_order_and_none_is_left_out_while_few_are_waiting(count):
    sent, heard = frames(count), []
    inbox = Inbox(filled(sent))
    for _ in sent:
        heard.append(inbox.next())
        assert inbox.unheard == 0
    assert heard == sent


def test_when_too_many_are_waiting_the_newest_is_next_and_the_others_are_counted():
    sent = frames(MOST_WAITING + 1)
    waiting = filled(sent)
    inbox = Inbox(waiting)
    assert inbox.next() is sent[-1] and inbox.unheard == MOST_WAITING
    waiting.put(after := frames(1)[0])
    assert inbox.next() is after and inbox.unheard == 0


def test_the_end_waits_for_nothing():
    assert Inbox(filled([*frames(3), None])).next() is None


class Slow:
    """Hears one frame while all others arrive."""

    hop = horizon = 1

    def __init__(self, inbox):
        self.inbox, self.late = inbox, [frames(60), [None]]

    def start(self, seed):
        return 0

    def step(self, speaker, memory):
        for frame in self.late.pop(0):
            self.inbox.put(frame)
        return Plan(speaker.time_s, np.array([speaker.time_s + FRAME_S]), np.zeros((1, 58), np.float32)), memory


def test_a_slow_listener_answers_the_newest_frame_and_tells_how_many_it_left_out():
    inbox = filled(frames(1))
    told, ours = multiprocessing.Pipe(duplex=False)
    listen(Slow(inbox), 0, Inbox(inbox), ours)
    ours.close()
    said = [told.recv() for _ in range(4)]
    assert [kind for kind, *_ in said] == ["ready", "plan", "unheard", "plan"]
    assert said[2][2] == 59 and said[3][1].made_at_s == pytest.approx(59 * FRAME_S)
