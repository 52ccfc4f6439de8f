"""The processes of `serve`: streams dealt among them, each heard as it would be alone; one that dies is replaced."""

import os
import queue
import signal
from contextlib import closing

import numpy as np
import pytest

from sfms_robot.app.serve.batch_process import Served
from sfms_robot.app.serve.service import WorkerPool
from sfms_robot.errors import ConfigError, ModelError
from sfms_robot.frames import FRAME_S, SpeakerFrame
from sfms_robot.listeners import remote_messages as messages
from sfms_robot.listeners.registry import at_hop, load_listener

LISTENER = "sfms-small"
HOP = 3
LIMIT_S = 240.0
SERVED = Served(listener=LISTENER, name="tested", hop=HOP, all_heads=True)


def joined(pool, client, seed=0):
    answers = queue.SimpleQueue()
    pool.join(messages.words_message(messages.Join(client, seed)), answers.put)
    said = messages.parse_words(answers.get(timeout=LIMIT_S))
    assert isinstance(said, messages.Welcome), said
    return said.stream


def voice(seed, frames):
    """16-bit sound, as it survives the way."""
    whole = np.random.default_rng(seed).integers(-3000, 3000, (frames, 640)).astype(np.float32) / 32768
    return [SpeakerFrame((index + 1) * FRAME_S, samples) for index, samples in enumerate(whole)]


def alone(seed, frames):
    listener = at_hop(load_listener(LISTENER, engine="onnx", threads=1), HOP)
    memory, plans = listener.start(seed), []
    for frame in frames:
        plan, memory = listener.step(frame, memory)
        plans += [] if plan is None else [plan.frames]
    return plans


def test_heads_are_dealt_evenly_and_each_has_the_frames_of_a_single_run():
    came = queue.SimpleQueue()
    with closing(WorkerPool(SERVED, lambda stream, message: came.put((stream, message)), processes=2)) as pool:
        heard = {joined(pool, str(seed), seed): voice(seed, 3 * HOP) for seed in range(4)}
        assert sorted(len(each.clients) for each in pool._workers) == [2, 2]
        for index in range(3 * HOP):
            for stream, frames in heard.items():
                pool.receive(stream, messages.frame_message(messages.SentFrame(index, frames[index], 0.0)))
        plans = {stream: [] for stream in heard}
        while any(len(each) < 3 for each in plans.values()):
            stream, message = came.get(timeout=LIMIT_S)
            plans[stream].append(messages.parse_plan(message).plan.frames)
        told = pool.statistics()
        assert (told["processes"], told["heads"], told["plans"]) == (2, 4, 12)
    for seed, (stream, frames) in enumerate(heard.items()):
        for one, other in zip(plans[stream], alone(seed, frames), strict=True):
            assert np.abs(one - other).max() < 1e-5


def test_a_process_that_dies_is_replaced_and_its_robots_are_told_to_join_again():
    came = queue.SimpleQueue()
    with closing(WorkerPool(SERVED, lambda stream, message: came.put((stream, message)), processes=1)) as pool:
        stream, first = joined(pool, "a"), pool._workers[0]
        assert joined(pool, "a") == stream
        os.kill(first.child.process.pid, signal.SIGKILL)
        pool._wait(lambda: pool._workers[0] is not first and pool._workers[0].capacity is not None)
        pool.receive(stream, b"anything")
        assert came.get(timeout=LIMIT_S) == (stream, messages.words_message(messages.Notice("unknown")))
        assert joined(pool, "a") != stream


@pytest.mark.parametrize(
    ("served", "error", "said"),
    [
        (Served(listener=LISTENER, name="tested", hop=99), ConfigError, "--hop 99: .*sfms-small.*valid: 1, 2"),
        (Served(listener="arig-paper", name="tested"), ModelError, "arig-paper"),
    ],
)
def test_what_cannot_be_served_is_said_as_it_is_in_one_process(served, error, said):
    with pytest.raises(error, match=said):
        WorkerPool(served, lambda *_: None, processes=2)
