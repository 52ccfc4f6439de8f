"""Many heads, one model: batches, deadlines, admission, and nobody in anybody's way."""

import math
from dataclasses import replace

import numpy as np
import pytest
from remote_rig import SILENCE, Counting, Network, Robot, Server
from tiny_sfms import plans_of, speech, tiny_listener

from sfms_robot.config.listener import Calmness
from sfms_robot.frames import FRAME_S, SpeakerFrame
from sfms_robot.listeners import remote_messages as messages
from sfms_robot.listeners.capacity import Capacity, measure_capacity
from sfms_robot.listeners.stream_server import DEADLINE_S, SILENT_S, StreamServer, report
from sfms_robot.listeners.thread import MOST_WAITING

LEAVE = messages.words_message(messages.Notice("leave"))


def joined(server, client="a", now_s=0.0, seed=0):
    said = messages.parse_words(server.join(messages.words_message(messages.Join(client, seed)), now_s))
    assert isinstance(said, messages.Welcome), said
    return said.stream


def frame(number, audio=SILENCE):
    return messages.frame_message(messages.SentFrame(number, SpeakerFrame((number + 1) * FRAME_S, audio), 0.0))


def stepped(server, now_s=0.0):
    """Everything that waits, batch by batch: [(stream, plan)]."""
    plans = []
    while (batch := server.batch()) is not None:
        for stream, message in server.finish(batch, server.step(batch), now_s, now_s):
            plans.append((stream, messages.parse_plan(message)))
    return plans


def test_all_who_are_due_are_one_batch_in_which_one_who_sends_all_at_once_has_one_place():
    listener = Counting()
    server = StreamServer(listener, "counting")
    for client in "abcde":
        server.receive(joined(server, client), frame(0), 0.0)
    assert len(stepped(server)) == 5
    assert listener.sizes == [5]
    listener = Counting()
    server = StreamServer(listener, "counting")
    greedy, modest = joined(server, "a"), joined(server, "b")
    for number in range(MOST_WAITING):
        server.receive(greedy, frame(number), 0.0)
    server.receive(modest, frame(0), 0.0)
    batch = server.batch()
    assert {stream.name for stream, _ in batch} == {greedy, modest}


def test_the_earliest_deadline_is_first_and_one_that_plans_before_one_that_does_not():
    server = StreamServer(Counting(), "counting")
    early, late = joined(server, "a"), joined(server, "b")
    server.receive(early, frame(0), 0.0)
    stepped(server)
    server.receive(early, frame(1), 0.00)  # its next plan is two steps away
    server.receive(late, frame(0), 0.01)  # its first asks for one
    assert [stream.name for stream, _ in server.batch()] == [late, early]


def test_streams_in_a_batch_are_in_no_other_until_it_is_finished():
    server = StreamServer(Counting(), "counting")
    stream = joined(server)
    server.receive(stream, frame(0), 0.0)
    server.receive(stream, frame(1), 0.0)
    first = server.batch()
    assert server.batch() is None and not server.waits
    server.finish(first, server.step(first), 0.0, 0.0)
    assert server.waits


def test_memory_of_a_stream_is_bounded_and_frames_late_or_twice_are_not_stepped_twice():
    server = StreamServer(Counting(), "counting")
    stream, notices = joined(server), []
    for number in range(500):
        notices += server.receive(stream, frame(number), 0.0)
    assert len(server._streams[stream].waiting) <= MOST_WAITING
    left_out = sum(messages.parse_words(each).frames for each in notices)
    assert left_out == server.counts["skipped_frames"] == 500 - len(server._streams[stream].waiting)
    server = StreamServer(Counting(), "counting")
    stream = joined(server)
    for number in (0, 2, 1, 2, 3):
        server.receive(stream, frame(number), 0.0)
    stepped(server)
    assert server._streams[stream].memory == (0, 4) and server.counts["lost_frames"] == 1


def test_heads_come_and_go_at_any_frame_and_each_hears_what_it_would_alone():
    """The law of a batch: N streams in one are N single runs, whenever each began, and whoever goes meanwhile."""
    listener, people = tiny_listener(), [speech(24, seed=seed) for seed in range(3)]
    server, plans, begin = StreamServer(listener, "tiny"), {}, (0, 5, 7)
    streams: dict[int, str] = {}
    for now in range(24 + max(begin)):
        for index, first in enumerate(begin):
            if now == first:
                streams[index] = joined(server, str(index), seed=index)
            if index in streams and now - first < 24:
                sent = messages.SentFrame(now - first, people[index][now - first], 0.0)
                server.receive(streams[index], messages.frame_message(sent), 0.0)
        if now == 20:  # one goes
            server.receive(streams[1], LEAVE, 0.0)
        for stream, sent in stepped(server):
            plans.setdefault(stream, []).append(sent.plan)
    for index in (0, 2):
        heard = [np.clip(np.rint(each.audio * 32768), -32768, 32767) / 32768 for each in people[index]]
        pairs = zip(people[index], heard, strict=True)
        speaker = [SpeakerFrame(each.time_s, audio.astype(np.float32), each.face) for each, audio in pairs]
        alone = [*plans_of(listener, speaker, seed=index).values()]
        found = plans[streams[index]]
        assert len(found) == len(alone)
        for one, other in zip(found, alone, strict=True):
            assert np.abs(one.frames - other.frames).max() < 1e-5


def test_who_is_silent_is_given_up_and_told_when_it_speaks_again():
    server = StreamServer(Counting(), "counting")
    stream = joined(server)
    server.expire(SILENT_S)
    assert server.heads == 1
    server.expire(SILENT_S + 0.1)
    assert server.heads == 0
    (answer,) = server.receive(stream, frame(0), 20.0)
    assert messages.parse_words(answer).kind == "unknown"


def test_who_asks_again_keeps_its_stream_and_calmness_that_cannot_be_is_refused():
    server, heeded = StreamServer(listener := Counting(), "counting"), []
    listener.calmed = lambda memory, calmness: heeded.append(calmness) or memory
    stream = joined(server, "a")
    server.join(messages.words_message(messages.Join("a", 0, {"nod": 5.0})), 0.0)
    assert stream == joined(server, "a") and server.heads == 1
    server.receive(stream, frame(0), 0.0)
    stepped(server)
    assert heeded == [Calmness(nod=5.0)]
    refusal = messages.parse_words(server.join(messages.words_message(messages.Join("a", 0, {"nod": 1e9})), 0.0))
    assert refusal.final and "nod" in refusal.reason


@pytest.mark.parametrize("changed", [{"motion": "deca56", "channels": ("x",)}, {"protocol": 2}, {"frame_hz": 30}])
def test_a_robot_of_another_kind_is_refused_with_both_sides_named(changed):
    server = StreamServer(Counting(), "counting", server="big")
    interface = replace(messages.OURS, version="9.9", **changed)
    refusal = messages.parse_words(server.join(messages.words_message(messages.Join("a", 0, None, interface)), 0.0))
    assert refusal.final and "sfms-robot 9.9" in refusal.reason and "server big" in refusal.reason
    assert server.counts["refused"] == 1 and server.heads == 0


@pytest.mark.parametrize("message", [b"", b"{}", b"\x00\x01", b'{"type": "join", "client": "a", "seed": "x"}'])
def test_nonsense_is_refused(message):
    refusal = messages.parse_words(StreamServer(Counting(), "counting").join(message, 0.0))
    assert refusal.final and "cannot take that" in refusal.reason


def test_random_bytes_to_a_stream_are_not_stepped_but_counted_and_the_first_is_logged(caplog):
    server = StreamServer(Counting(), "counting")
    stream = joined(server, "robot-7")
    for message in (b"", b"\x01", b"{", frame(0)[:-1]):
        assert server.receive(stream, message, 0.0) == []
    server.join(b"nonsense", 0.0)
    assert server.batch() is None and report([server.figures(), server.figures()])["malformed"] == 10
    (line,) = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert f"stream {stream} of 'robot-7'" in line and "only counted" in line


def slow(scale):
    """A millisecond a head and five for any batch, times `scale`."""
    sizes = (1, 2, 4, 8, 16)
    plan_s, other_s = (
        tuple(scale * (any_s + each_s * n) for n in sizes) for any_s, each_s in ((5e-3, 1e-3), (0, 1e-4))
    )
    return Capacity(hop=3, sizes=sizes, plan_s=plan_s, other_s=other_s)


def test_heads_are_admitted_until_the_deadline_cannot_be_held_and_the_reason_has_figures():
    capacity = slow(1.0)
    server = StreamServer(Counting(), "counting", capacity)
    for index in range(capacity.most(DEADLINE_S)):
        joined(server, str(index))
    refusal = messages.parse_words(server.join(messages.words_message(messages.Join("one more", 0)), 0.0))
    assert not refusal.final and "is full" in refusal.reason and "80 ms are promised" in refusal.reason
    server.receive(next(iter(server._streams)), LEAVE, 0.0)
    joined(server, "one more")


def test_a_slower_machine_admits_fewer_and_delay_grows_with_heads():
    assert slow(1.0).most(DEADLINE_S) > slow(2.0).most(DEADLINE_S) > slow(4.0).most(DEADLINE_S)
    delays = [slow(1.0).delay_s(n, DEADLINE_S) for n in range(1, 40)]
    assert delays == sorted(delays)
    assert math.isinf(slow(100.0).delay_s(1, DEADLINE_S))


def test_batches_that_take_longer_than_measured_close_the_door():
    server = StreamServer(Counting(hop=1), "counting", slow(1.0))
    stream, before = joined(server), server.figures().most_heads
    for number in range(200):
        server.receive(stream, frame(number), number * FRAME_S)
        batch = server.batch()
        server.finish(batch, server.step(batch), number * FRAME_S, number * FRAME_S + 0.03)
    assert server.figures().most_heads < before and server.figures().cost_scale > 2


def test_costs_are_measured_batch_by_batch():
    time_s = [0.0]

    class Timed(Counting):
        def step_each(self, speakers, memories):
            answers = super().step_each(speakers, memories)
            time_s[0] += 0.01 * len(speakers) if answers[0][0] is not None else 0.001
            return answers

    capacity = measure_capacity(Timed(), sizes=(1, 2, 4), now_s=lambda: time_s[0])
    assert capacity.plan_s == pytest.approx((0.01, 0.02, 0.04))
    assert capacity.other_s == pytest.approx((0.001,) * 3) and capacity.batch_s(8, 0) == pytest.approx(0.08)


@pytest.mark.parametrize("heads", [1, 8])
def test_a_slow_robot_delays_nobody_and_deadlines_are_met(heads):
    network, slow_network = Network(0.01), Network(1.5, 0.5, 0.3)
    server = Server(Counting(), network, batch_s=0.02)
    robots = [Robot(network, server, seed) for seed in range(heads)]
    laggard = Robot(slow_network, server, 99)
    for _ in range(300):
        for each in (*robots, laggard):
            each.run(0.01)
    delays = [each.feed.statistics()["link"]["frame_to_plan_ms"]["p99"] for each in robots]
    assert max(delays) <= 80
    assert all(not each.feed.lost for each in robots)
