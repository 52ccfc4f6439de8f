import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.emulator.faults import KINDS, TO_SERVOS, WireFaults, parse_fault
from sfms_robot.errors import ConfigError

SENDER, REPLY = (3,), bytes(range(40))


@pytest.mark.parametrize(
    ("text", "kind", "ids", "start_s", "end_s", "value"),
    [
        ("drop", "drop", None, 0.0, math.inf, 1.0),
        ("drop:3,5-7@2-4=0.5", "drop", {3, 5, 6, 7}, 2.0, 4.0, 0.5),
        ("delay:2=0.012", "delay", {2}, 0.0, math.inf, 0.012),
        ("noise@1.5-=0.1", "noise", None, 1.5, math.inf, 0.1),
        ("brownout@1", "brownout", None, 1.0, 1.2, 0.0),
        ("hangup@1-3", "hangup", None, 1.0, 3.0, 1.0),
        ("load:1=-0.25", "load", {1}, 0.0, math.inf, -0.25),
        ("request-corrupt@1-2=0.3", "request-corrupt", None, 1.0, 2.0, 0.3),
        ("request-delay", "request-delay", None, 0.0, math.inf, 0.02),
    ],
)
def test_spec_is_read(text, kind, ids, start_s, end_s, value):
    fault = parse_fault(text)
    assert (fault.kind, fault.ids) == (kind, ids and frozenset(ids))
    assert (fault.start_s, fault.end_s, fault.value) == pytest.approx((start_s, end_s, value))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("dorp", "has no such kind as 'dorp' (drop, delay"),
        ("drop=1.5", "is out of range: fraction of replies of drop (0..1)"),
        ("drop:9-3", "holds a bad number"),
        ("drop:1-999", "holds a bad number"),
        ("drop@4-2", "ends at 2 s, before it starts"),
        ("drop@1.2.3", "holds a bad number"),
        ("stuck:1=4", "has no value"),
        ("noise:3", "cannot name ids"),
        ("request-drop:3", "cannot name ids: request-drop concerns the whole wire"),
        ("request-drop=2", "is out of range: fraction of requests of request-drop (0..1)"),
        ("voltage", "needs a value in volts"),
        ("drop three", "cannot be read"),
        ("", "cannot be read"),
    ],
)
def test_bad_spec_is_one_clear_line(text, problem):
    with pytest.raises(ConfigError, match=re.escape(problem)) as caught:
        parse_fault(text)
    assert "\n" not in str(caught.value) and repr(text) in str(caught.value)


@given(st.text(max_size=30))
def test_any_text_is_a_fault_or_a_config_error(text):
    try:
        assert parse_fault(text).kind in KINDS
    except ConfigError:
        return


def faults_of(*specs: str, seed: int = 0) -> WireFaults:
    faults = WireFaults(seed)
    for spec in specs:
        faults.add(parse_fault(spec))
    return faults


def spoilt(*specs: str, servos=SENDER, now_s: float = 0.0):
    return faults_of(*specs).spoil(servos, REPLY, now_s)


def test_what_becomes_of_a_reply():
    assert spoilt() == [(REPLY, 0.0)] and spoilt("drop") == []
    assert spoilt("duplicate") == [(REPLY, 0.0)] * 2 and spoilt("delay=0.01") == [(REPLY, 0.01)]
    [(short, _)] = spoilt("truncate")
    assert REPLY.startswith(short) and len(short) < 40
    [(wrong, _)] = spoilt("corrupt")
    assert len(wrong) == 40 and sum(a != b for a, b in zip(wrong, REPLY, strict=True)) == 1
    assert spoilt("duplicate", "delay=0.01", "drop:4") == [(REPLY, 0.01)] * 2


def test_faults_of_requests_and_of_replies_stay_apart():
    faults = faults_of("request-drop", "request-delay=0.01", "drop:3")
    assert faults.spoil(SENDER, REPLY, 0.0) == [] and faults.spoil((4,), b"x", 0.0) == [(b"x", 0.0)]
    assert faults.spoil((), b"x", 0.0, TO_SERVOS) == []
    late = faults_of("request-delay=0.01", "request-corrupt", "delay", "drop")
    [(wrong, late_s)] = late.spoil(SENDER, REPLY, 0.0, TO_SERVOS)
    assert late_s == 0.01 and sum(a != b for a, b in zip(wrong, REPLY, strict=True)) == 1


def test_fault_is_only_there_in_its_time_and_for_its_ids():
    assert spoilt("drop@1-2", now_s=0.9) and not spoilt("drop@1-2", now_s=1.0) and spoilt("drop@1-2", now_s=2.0)
    assert spoilt("drop:4") and not spoilt("drop:3") and not spoilt("drop:4", servos=(1, 4))


def test_one_seed_throws_the_same_dice():
    def run(seed):
        faults = faults_of("drop=0.5", "corrupt=0.5", seed=seed)
        return [faults.spoil(SENDER, REPLY, 0.01 * k) for k in range(200)]

    assert run(1) == run(1) != run(2) and 60 < sum(not replies for replies in run(1)) < 140


def test_beginnings_and_ends_come_once_in_order_and_clearing_ends_what_goes_on():
    faults = faults_of("stuck:1@2-3", "overload:2@1")
    assert faults.next_s == 1.0
    assert [(t, f.kind, began) for t, f, began in faults.edges(2.5)] == [(1.0, "overload", True), (2.0, "stuck", True)]
    assert [(t, f.kind, began) for t, f, began in faults.edges(9.0)] == [(3.0, "stuck", False)]
    assert list(faults.edges(9.0)) == [] and faults.next_s == math.inf
    faults = faults_of("stuck:1", "drop@5", "drop")
    assert len(list(faults.edges(1.0))) == 2
    faults.clear(1.0)
    assert [(f.kind, began) for _, f, began in faults.edges(1.0)] == [("stuck", False), ("drop", False)]
    assert faults.spoil(SENDER, REPLY, 6.0) == [(REPLY, 0.0)] and faults.texts(6.0) == []
