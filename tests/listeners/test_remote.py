"""A listener on another machine, over networks that are slow, uneven, lossy and away. In virtual time."""

import json
import logging

import pytest
from remote_rig import Counting, Network, Robot, Server, frames

from sfms_robot.config.listener import Calmness
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_S
from sfms_robot.listeners.remote import HUNG_S
from sfms_robot.listeners.remote_messages import Notice, Refusal, words_message


def robot(network=None, **listener):
    network = network or Network()
    return Robot(network, Server(Counting(**listener), network))


def figures(head):
    return head.feed.statistics()


def test_plans_come_as_from_a_listener_of_ones_own():
    head = robot().run(4.0)
    assert figures(head)["state"] == "listening" and not head.feed.lost
    listener, memory, own = Counting(), (0, 0), []
    for frame in frames(round(head.plans[-1][1].made_at_s / FRAME_S)):
        plan, memory = listener.step(frame, memory)
        own += [] if plan is None else [plan]
    heard_from = head.plans[0][1].made_at_s
    assert [plan.frames.tolist() for _, plan in head.plans] == [plan.frames.tolist() for plan in own][: len(head.plans)]
    assert heard_from <= 0.12


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("horizon", "hop"), [(8, 2), (8, 3), (1, 1)])
def test_50_ms_20_ms_of_jitter_and_2_percent_of_loss_leave_no_gap_over_120_ms(horizon, hop, seed):
    head = robot(Network(0.05, 0.02, 0.02, seed), horizon=horizon, hop=hop).run(30.0)
    settled = [gap for at_s, gap in head.gaps_s if at_s > 2.0]
    assert max(settled, default=0.0) <= 0.120
    assert all(state != "hung" for _, state in head.states)


@pytest.mark.parametrize("seed", range(2))
def test_after_an_outage_of_five_seconds_it_is_back_within_one(seed):
    network = Network(0.05, 0.02, 0.02, seed)
    head = robot(network).run(10.0)
    network.up = False
    head.run(5.0)
    assert head.feed.lost and figures(head)["state"] == "hung"
    assert next(at_s for at_s, state in head.states if state == "hung") <= 10.0 + HUNG_S + 0.3
    network.up = True
    before = len(head.plans)
    head.run(1.0)
    assert not head.feed.lost and head.plans[before][0] <= 16.0
    head.run(5.0)
    assert max((gap for at_s, gap in head.gaps_s if at_s > 16.0), default=0.0) <= 0.120
    assert figures(head)["link"]["outages"] == 1


def test_a_stream_that_was_given_up_begins_anew():
    network = Network(0.02)
    head = robot(network).run(3.0)
    network.up = False
    for _ in range(15):
        head.run(1.0)
        head.server.core.expire(head.server.now_s())
    assert head.server.core.heads == 0
    network.up = True
    head.run(2.0)
    assert not head.feed.lost and head.server.core.heads == 1 and figures(head)["restarts"] == 1


def test_a_server_that_was_started_anew_is_joined_again(caplog):
    network = Network(0.02)
    head = robot(network).run(3.0)
    head.server.core = Server(Counting(), network).core
    with caplog.at_level(logging.WARNING):
        head.run(2.0)
    assert not head.feed.lost and figures(head)["restarts"] == 1
    assert "was started again" in caplog.text


def test_an_event_is_told_once_though_it_is_sent_with_three_plans_and_some_are_lost():
    head = robot(Network(0.05, 0.02, 0.05, seed=3)).run(30.0)
    told = [round(event.start_s, 3) for _, plan in head.plans for event in plan.events]
    assert len(told) == len(set(told))
    lossless = robot(Network(0.05)).run(30.0)
    assert len(told) >= 0.95 * sum(len(plan.events) for _, plan in lossless.plans)


def test_a_refusal_for_good_or_another_version_ends_the_start_with_both_sides_named(caplog):
    head = robot()
    head.link.ask = lambda message: head.link.arrived(words_message(Refusal("this robot is A, b is B", final=True)))
    with pytest.raises(ConfigError, match="zenoh/counting: this robot is A, b is B"):
        head.feed.wait_loaded(1.0)
    head = robot()
    told = json.loads(head.server.core.join(asking(head), 0.0)) | {}
    told["interface"]["motion"] = "deca56"
    head.link.ask = lambda message: head.link.arrived(json.dumps(told).encode())
    head.run(0.5)
    assert head.feed.lost and figures(head)["state"] == "refused"
    assert "arkit58" in figures(head)["why"] and "deca56" in figures(head)["why"]


def test_plans_wait_for_late_ones_also_of_a_stream_that_was_joined_before_the_loop():
    head = robot(Network(0.05, 0.02), horizon=1, hop=1)
    head.link.ask = lambda message: head.link.arrived(head.server.core.join(message, head.server.now_s()))
    head.feed.wait_loaded(1.0)
    assert not head.feed.lost and figures(head.run(4.0))["link"]["buffer_ms"] > 60


def asking(head):
    asked = []
    head.link.ask, ask = asked.append, head.link.ask
    head.feed.poll(0.0)
    head.link.ask = ask
    return asked[0]


def test_nobody_there_is_told_after_a_while_and_the_head_begins_without(caplog):
    network = Network()
    network.up = False
    head = robot(network)
    head.feed.wait_loaded(0.02)
    assert "does not answer: the head begins without it" in caplog.text
    assert head.feed.lost
    network.up = True
    head.run(1.0)
    assert not head.feed.lost


def test_random_bytes_from_a_server_are_counted_and_said_once(caplog):
    head = robot().run(1.0)
    for _ in range(5):
        head.link.arrived(b"\x02\x01 what is this")
        head.link.arrived(b"{ nothing }")
    head.run(1.0)
    assert figures(head)["link"]["refused_messages"] == 10
    assert len([each for each in caplog.records if "sends" in each.message]) == 1
    assert not head.feed.lost


def test_calmness_reaches_the_stream_what_was_left_out_is_counted_and_close_says_goodbye():
    head = robot().run(1.0)
    head.feed.calm(Calmness(nod=5.0))
    heeded = []
    head.server.core._listener.calmed = lambda memory, calmness: heeded.append(calmness) or memory
    head.run(0.2)
    assert heeded == [Calmness(nod=5.0)]
    head = robot().run(1.0)
    head.link.arrived(words_message(Notice("skipped", frames=7)))
    head.run(0.1)
    assert figures(head)["skipped_frames"] >= 7
    head = robot().run(1.0)
    head.feed.close()
    head.network.advance(2.0)
    assert head.server.core.heads == 0 and head.link.closed
    head.feed.close()
