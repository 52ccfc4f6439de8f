"""Puppeteering: laid over the listener's face, continuous, and gone in the end."""

import math

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sfms_robot.config import Gaze
from sfms_robot.errors import InputError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM
from sfms_robot.retarget.puppet import EYES_S, FALL_S, HEAD_S, RISE_S, Puppet
from sfms_robot.signals.gaze_kinematics import directions

DT_S = 0.01
LEADS_S = np.array([0.0, 0.02, 0.05, 0.11])
FULL_RAD = np.radians([Gaze().full_yaw_deg, Gaze().full_pitch_deg])
YAW, PITCH, JAW = (CHANNEL_INDEX[name] for name in ("yaw", "pitch", "jawOpen"))


def base_face(seed=0):
    rng = np.random.default_rng(seed)
    return np.r_[rng.uniform(-0.2, 0.2, 6), rng.uniform(0, 0.5, 52)].astype(np.float32)


def play(puppet, ticks, face, asked=(), leads_s=LEADS_S):
    """(ticks, leads, 58) of a listener that holds `face`; `asked`: tick -> what is asked before it."""
    asked, out = dict(asked), []
    for tick in range(ticks):
        if tick in asked:
            asked[tick](puppet)
        times = tick * DT_S + leads_s
        out.append(puppet.overlay(np.tile(face, (len(leads_s), 1)), times))
    return np.array(out)


def test_a_face_that_nobody_works_is_the_listeners_own_and_the_input_is_never_changed():
    motion = np.random.default_rng(1).normal(size=(5, MOTION_DIM)).astype(np.float32)
    assert Puppet().overlay(motion, np.arange(5) / 25) is motion
    puppet, motion = Puppet(), np.tile(base_face(), (4, 1))
    puppet.show({"jawOpen": 1.0}, 1.0)
    kept = motion.copy()
    puppet.overlay(motion, LEADS_S)
    puppet.overlay(motion, LEADS_S + 0.5)
    assert np.array_equal(motion, kept)


def test_a_whole_face_is_reached_held_and_left_again():
    face, wanted = base_face(), base_face(7)
    rows = play(Puppet(), 200, face, {10: lambda p: p.show(wanted, 0.5)}, np.zeros(1))[:, 0]
    assert np.array_equal(rows[:11], np.tile(face, (11, 1)))
    risen, falls = 10 + round(RISE_S / DT_S), 10 + round((RISE_S + 0.5) / DT_S)
    assert np.allclose(rows[risen : falls + 1], wanted, atol=1e-6)
    assert np.array_equal(rows[falls + round(FALL_S / DT_S) + 1], face) and np.array_equal(rows[-1], face)


def test_channels_that_are_not_named_stay_the_listeners_and_a_stream_of_faces_takes_no_room():
    face = base_face()
    rows = play(Puppet(), 100, face, {5: lambda p: p.show({"jawOpen": 1.0}, 0.2)}, np.zeros(1))[:, 0]
    others = np.delete(np.arange(MOTION_DIM), JAW)
    assert np.array_equal(rows[:, others], np.tile(face[others], (100, 1)))
    assert rows[:, JAW].max() == pytest.approx(1.0)
    puppet, still = Puppet(), np.zeros(MOTION_DIM, np.float32)
    wanted = [0.5 + 0.4 * math.sin(tick / 15) for tick in range(400)]
    asked = {tick: lambda p, v=wanted[tick]: p.show({"jawOpen": v}, 0.3) for tick in range(0, 400, 4)}
    jaw = play(puppet, 400, still, asked, np.zeros(1))[:, 0, JAW]
    assert np.abs(jaw[60:] - np.array(wanted)[50:-10]).max() < 0.1  # a tenth of a second behind
    assert len(puppet._pieces) <= 5


seconds = st.floats(0.02, 0.6)
shows = st.tuples(st.just("show"), st.integers(1, 50), seconds) | st.tuples(st.just("jaw"), st.floats(0, 1), seconds)
looks = st.tuples(st.just("look"), st.floats(-0.3, 0.3), st.floats(0.05, 0.6))
asked_at = st.lists(st.tuples(st.integers(0, 150), shows | looks), max_size=12)


@settings(phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(asked_at, st.integers(0, 5))
def test_whatever_is_asked_the_face_moves_without_a_jump_and_ends_as_the_listeners(asked, seed):
    """No joint, whatever its lead, jumps; no channel leaves what listener and puppeteer asked for."""

    def ask(puppet, each):
        for kind, what, seconds in each:
            if kind == "show":
                puppet.show(base_face(what), seconds)
            elif kind == "jaw":
                puppet.show({"jawOpen": what}, seconds)
            else:
                puppet.look_at(1.0, what, 0.5 * what, seconds)

    face = base_face(seed)
    face[[CHANNEL_INDEX[f"eyeLook{way}"] for way in ("InLeft", "OutRight", "UpLeft", "UpRight")]] = 0.0
    by_tick = {tick: [each for at, each in asked if at == tick] for tick, _ in asked}
    rows = play(Puppet(), 420, face, {tick: lambda p, each=each: ask(p, each) for tick, each in by_tick.items()})
    assert np.isfinite(rows).all()
    steps = np.abs(np.diff(rows, axis=0)).max(axis=(0, 1))
    turned = np.zeros(MOTION_DIM, bool)
    turned[[YAW, PITCH]] = True
    turned[[i for name, i in CHANNEL_INDEX.items() if name.startswith("eyeLook")]] = True
    assert steps[~turned].max() < 0.16  # of a tick, where the fastest ramp crosses the whole range in 0.12 s
    assert steps[turned].max() < 0.4 + 0.16  # a saccade of both eyes, while something else fades
    assert np.allclose(rows[-1], face, atol=1e-6)


def test_eyes_go_first_the_head_follows_and_the_gaze_stays_on_the_point():
    rows = play(
        Puppet(), 150, np.zeros(MOTION_DIM, np.float32), {0: lambda p: p.look_at(1.0, 0.3, 0.1, 1.0)}, np.zeros(1)
    )
    motion = rows[:, 0]
    eyes, head = directions(motion, FULL_RAD).mean(axis=1), motion[:, [YAW, PITCH]]
    wanted = np.array([math.atan2(0.3, 1.0), -math.atan2(0.1, math.hypot(1.0, 0.3))])
    early, late = round(EYES_S / DT_S) + 1, round(HEAD_S / DT_S) + 5
    assert np.allclose((eyes + head)[early:late], wanted, atol=1e-3)
    assert np.abs(head[early]).max() < 0.1 * np.abs(wanted).max()
    assert np.allclose(head[late], 0.6 * wanted, atol=1e-3)
    assert wanted[0] > 0 and wanted[1] < 0  # to its left, and up: nose down is +


def test_a_head_without_eyes_turns_all_the_way_and_one_without_a_neck_its_eyes():
    point = {0: lambda p: p.look_at(1.0, 0.2, 0.0, 2.0)}
    still = np.zeros(MOTION_DIM, np.float32)
    blind_eyes = frozenset(name for name in CHANNEL_INDEX if name.startswith("eyeLook"))
    eyeless = play(Puppet(blind=blind_eyes), 120, still, point, np.zeros(1))[100, 0]
    stiff = play(Puppet(blind=frozenset({"yaw", "pitch"})), 120, still, point, np.zeros(1))[100, 0]
    assert eyeless[YAW] == pytest.approx(math.atan2(0.2, 1.0), abs=1e-4) and stiff[YAW] == 0.0
    assert directions(stiff, FULL_RAD).mean(axis=0)[0] == pytest.approx(math.atan2(0.2, 1.0), abs=1e-4)


REFUSED = [
    (lambda p: p.show({"jaw": 0.1}, 1), "'jaw' is not a channel"),
    (lambda p: p.show({"jawOpen": 1.5}, 1), "jawOpen = 1.5 is not a number in its range"),
    (lambda p: p.show({"yaw": 4.0}, 1), "yaw = 4"),
    (lambda p: p.show(np.full(58, np.nan), 1), "roll = nan"),
    (lambda p: p.show(np.zeros(52), 1), r"shape \(52,\)"),
    (lambda p: p.show(np.zeros(58), 0), "seconds = 0"),
    (lambda p: p.show(np.zeros(58), math.inf), "seconds = inf"),
    (lambda p: p.look_at(0, 0, 0, 1), r"look_at\(0, 0, 0\) is not a point"),
    (lambda p: p.look_at(math.nan, 0, 0, 1), "is not a point"),
    (lambda p: p.look_at(1, 0, 0, -1), "seconds = -1"),
]


@pytest.mark.parametrize(("ask", "message"), REFUSED)
def test_what_cannot_be_shown_is_refused_and_changes_nothing(ask, message):
    puppet, motion = Puppet(), np.tile(base_face(), (4, 1))
    with pytest.raises(InputError, match=message):
        ask(puppet)
    assert puppet.overlay(motion, LEADS_S) is motion
