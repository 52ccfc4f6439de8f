import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_rows import motions

from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, SHAPES, Plan
from sfms_robot.motion.timeline import EASE_S, HISTORY, LEAD_S, STALL_S, PlanTimeline

TICK_S = 0.01
PITCH, BLINK, SMILE = (CHANNEL_INDEX[name] for name in ("pitch", "eyeBlinkLeft", "mouthSmileLeft"))
TIMELINE = PlanTimeline(TICK_S)


def plan(made_at_s: float, frames) -> Plan:
    frames = np.asarray(frames, np.float32)
    return Plan(made_at_s, made_at_s + FRAME_S * np.arange(1, len(frames) + 1), frames)


def cut(frames, start: int, horizon: int = 8) -> Plan:
    """The plan made `start` frames into a recording: its next `horizon` frames."""
    return plan(start * FRAME_S, frames[start + 1 : start + 1 + horizon])


def ran(frames, lead_s=0.0, horizon=8, hop=4, latency_ticks=2):
    """Ticks through a recording cut into plans: times asked for (T,), motion (T, 58), last state."""
    state, times, rows = TIMELINE.start(), [], []
    for tick in range(4 * (len(frames) - horizon - 1)):
        step, rest = divmod(tick - latency_ticks, 4)
        if rest == 0 and step >= 0 and step % hop == 0:
            state = TIMELINE.accept(cut(frames, step, horizon), state)
        asked = np.array([tick * TICK_S + lead_s])
        motion, state = TIMELINE.sample(asked, tick * TICK_S, state)
        times.append(asked[0])
        rows.append(motion[0])
    return np.array(times), np.array(rows), state


def at(state, *times_s, now_s=None) -> np.ndarray:
    times = np.array(times_s)
    return TIMELINE.sample(times, times.min() if now_s is None else now_s, state)[0]


def test_before_any_plan_the_face_is_neutral():
    assert not at(TIMELINE.start(), 0.0, 5.0).any()


def test_frames_are_met_at_their_times():
    frames = np.random.default_rng(0).uniform(0, 1, (12, MOTION_DIM)).astype(np.float32)
    state = TIMELINE.accept(cut(frames, 3), TIMELINE.start())
    played = at(state, *(FRAME_S * np.arange(6, 12)), now_s=0.2)  # the first two are blended with neutral
    still = np.ones(MOTION_DIM, bool)
    still[[BLINK, BLINK + 1]] = False
    assert played[:, still] == pytest.approx(frames[6:12, still], abs=1e-6)
    assert (played[:, ~still] >= frames[6:12, ~still] - 1e-6).all()


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.floats(0, 0.05))
def test_blendshapes_stay_between_the_frames_around_them(seed, hop, lead_s):
    frames = np.random.default_rng(seed).uniform(0, 1, (40, MOTION_DIM)).astype(np.float32)
    times, rows, _ = ran(frames, lead_s, hop=hop)
    shapes, given_shapes = rows[:, SHAPES], frames[:, SHAPES]
    assert shapes.min() >= 0 and shapes.max() <= 1
    for t, row in zip(times[40:], shapes[40:], strict=True):
        around = given_shapes[int(np.floor(t / FRAME_S - 0.51)) : int(np.floor(t / FRAME_S + 0.51)) + 2]
        assert (row >= around.min(axis=0) - 1e-5).all() and (row <= around.max(axis=0) + 1e-5).all()


@pytest.mark.parametrize("lead_s", [0.0, 0.017, 0.04])
def test_a_nod_is_played_without_lag_or_added_jerk(lead_s):
    def nod(t):
        return np.radians(2.5) * np.sin(2 * np.pi * 2.0 * t)

    times, rows, _ = ran(motions(120, pitch=nod(FRAME_S * np.arange(120))), lead_s)
    played, true = rows[50:, PITCH].astype(np.float64), nod(times[50:])
    assert np.abs(played - true).max() < np.radians(0.002)

    def jerk(x):
        return np.sqrt(np.mean(np.diff(x, 3) ** 2)) / TICK_S**3

    assert jerk(played) < 1.1 * jerk(true)


@pytest.mark.parametrize("phase_s", np.arange(0, FRAME_S, 0.003))
def test_a_blink_of_one_frame_reaches_its_peak_at_a_tick_wherever_the_ticks_fall(phase_s):
    _, rows, _ = ran(motions(30, eyeBlinkLeft=[1.0 if k == 15 else 0.0 for k in range(30)]), lead_s=phase_s)
    assert rows[:, BLINK].max() == pytest.approx(1.0) and rows[:, BLINK].min() == 0.0


def test_a_face_beyond_its_range_is_played_at_the_end_of_it():
    state = TIMELINE.accept(plan(0.0, motions(8, mouthSmileLeft=1.5, jawOpen=-0.5, pitch=0.3)), TIMELINE.start())
    smile, jaw, pitch = at(state, 0.2)[0, [SMILE, CHANNEL_INDEX["jawOpen"], PITCH]]
    assert (smile, jaw) == (1.0, 0.0) and pitch == pytest.approx(0.3)


def test_a_newer_plan_takes_over_within_two_frames():
    old, new = motions(8, pitch=0.0, mouthSmileLeft=0.0), motions(8, pitch=0.3, mouthSmileLeft=0.9)
    state = TIMELINE.accept(plan(0.0, old), TIMELINE.start())
    state = TIMELINE.accept(plan(0.08, new), state)
    first, second, third = at(state, 0.12, 0.16, 0.20)
    assert [first[PITCH], second[PITCH], third[PITCH]] == pytest.approx([0.1, 0.2, 0.3])
    assert [first[SMILE], second[SMILE], third[SMILE]] == pytest.approx([0.3, 0.6, 0.9])


def test_blinks_are_joined_by_maximum():
    shut, open_ = motions(8, eyeBlinkLeft=1.0), motions(8)
    for one, other in ((shut, open_), (open_, shut)):
        state = TIMELINE.accept(plan(0.0, one), TIMELINE.start())
        state = TIMELINE.accept(plan(0.12, other), state)
        assert at(state, 0.16)[0, BLINK] == at(state, 0.20)[0, BLINK] == 1.0


def test_what_was_played_is_never_changed_by_a_later_plan():
    rng = np.random.default_rng(1)
    state = TIMELINE.accept(plan(0.0, rng.uniform(0, 1, (8, MOTION_DIM))), TIMELINE.start())
    seen = np.arange(0.0, 0.2, 0.003)
    before, state = TIMELINE.sample(seen, 0.15, state)
    state = TIMELINE.accept(plan(0.12, rng.uniform(0, 1, (8, MOTION_DIM))), state)
    after = at(state, *seen, now_s=0.15)
    after[-10:, BLINK : BLINK + 2] = before[-10:, BLINK : BLINK + 2]  # widening a blink looks half a frame ahead
    assert after == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("horizon, hop, lead_s", [(8, 4, 0.03), (8, 1, 0.03), (8, 7, 0.0), (1, 1, 0.0), (1, 1, 0.04)])
def test_speed_is_continuous_however_plans_disagree(horizon, hop, lead_s):
    rng = np.random.default_rng(2)
    state, seen = TIMELINE.start(), []
    fine_s = 0.0005
    for k in range(40):
        if k % hop == 0:
            state = TIMELINE.accept(plan(k * FRAME_S, rng.uniform(-0.2, 0.2, (horizon, MOTION_DIM))), state)
        asked = k * FRAME_S + lead_s + fine_s * np.arange(80)
        motion, state = TIMELINE.sample(asked, k * FRAME_S, state)
        seen.append(motion[:, PITCH])
    speed = np.diff(np.concatenate(seen).astype(np.float64)) / fine_s
    assert np.abs(np.diff(speed)).max() < 0.1 * np.abs(speed).max()


def test_past_the_horizon_it_goes_on_for_one_frame_then_holds_and_counts():
    state = TIMELINE.accept(plan(0.0, motions(8, pitch=0.01 * np.arange(8))), TIMELINE.start())
    rows, after = TIMELINE.sample(np.array([0.32, 0.36]), 0.3, state)
    assert rows[:, PITCH] == pytest.approx([0.07, 0.08]) and after.held == 0
    rows, after = TIMELINE.sample(np.array([0.40, 0.45]), 0.4, after)
    assert rows[:, PITCH] == pytest.approx([0.08, 0.08]) and after.held == 1


def test_without_plans_the_face_eases_to_neutral_and_the_next_plan_is_taken_up():
    smile = motions(8, mouthSmileLeft=1.0, pitch=0.2)
    state = TIMELINE.accept(plan(0.0, smile), TIMELINE.start())
    assert at(state, STALL_S)[0, SMILE] == pytest.approx(1.0)
    fading = at(state, *(STALL_S + np.linspace(0, EASE_S, 50)))[:, SMILE]
    assert (np.diff(fading) <= 0).all() and fading[-1] == pytest.approx(0.0, abs=1e-6)
    rows, state = TIMELINE.sample(np.array([5.0]), 5.0, state)
    assert not rows.any() and state.eased == 1
    state = TIMELINE.accept(plan(5.0, smile), state)
    rows = at(state, *np.arange(5.0, 5.3, 0.001))
    assert rows[-1, SMILE] == pytest.approx(1.0) and np.abs(np.diff(rows[:, PITCH])).max() < 0.01


def test_plans_of_one_frame_are_played_one_frame_late_and_move_the_face_however_late():
    times, rows, state = ran(motions(40, pitch=0.01 * np.arange(40)), horizon=1, hop=1)
    assert rows[20:, PITCH] == pytest.approx(0.01 * (times[20:] / FRAME_S - 1), abs=1e-5)
    assert state.held == state.late == 0
    frames = motions(80, mouthSmileLeft=[k >= 20 for k in range(80)])
    _, rows, state = ran(frames, lead_s=0.2, horizon=1, hop=1, latency_ticks=8)
    assert rows[-1, SMILE] == pytest.approx(1.0) and state.refused == 0


@pytest.mark.parametrize(
    "bad",
    [
        plan(0.2, motions(8, pitch=np.nan)),
        plan(0.2, motions(8, eyeBlinkLeft=np.inf)),
        plan(0.2, np.zeros((8, 57))),
        plan(0.2, np.zeros((0, 58))),
        Plan(0.2, np.array([0.28, 0.24]), motions(2)),
        Plan(np.nan, np.array([0.24]), motions(1)),
        plan(0.0, motions(8)),
    ],
    ids=["NaN", "inf", "narrow", "empty", "time running backwards", "no time", "older than the last"],
)
def test_a_plan_that_cannot_be_used_is_counted_and_changes_nothing(bad):
    state = TIMELINE.accept(plan(0.1, motions(8, pitch=0.1)), TIMELINE.start())
    after = TIMELINE.accept(bad, state)
    assert after.refused == 1 and after.curve is state.curve


def test_the_jaw_pose_replaces_jaw_open():
    jaw = np.zeros((8, 3), np.float32)
    jaw[:, 1] = np.radians(12.5)
    with_jaw = Plan(0.0, FRAME_S * np.arange(1, 9), motions(8, jawOpen=0.9), jaw)
    state = TIMELINE.accept(with_jaw, TIMELINE.start())
    assert at(state, 0.2)[0, CHANNEL_INDEX["jawOpen"]] == pytest.approx(0.5)


def test_the_state_stays_small():
    _, _, state = ran(motions(200, pitch=0.1), hop=1)
    assert len(state.curve.knots.times_s) <= HISTORY + 12


def horizon_left_s(horizon: int, hop: int, latency_s: float) -> float:
    """Longest lead [s] that never runs past the plan: plans of `horizon` frames every `hop`, visible after `latency_s`.

    Negative when plans come too late even without a lead.
    """
    delay = 1 if horizon == 1 else 0
    return (horizon - hop + delay) * FRAME_S - latency_s


def led(horizon: int, hop: int, latency_s: float, lead_s: float, seconds: float = 6.0):
    """Times asked for (T,) and the last state, of a listener whose plans become visible after `latency_s`."""
    state, asked, rng = TIMELINE.start(), [], np.random.default_rng(0)
    for tick in range(round(seconds / TICK_S)):
        now_s = tick * TICK_S
        for k in range(0, int(seconds / FRAME_S), hop):
            if now_s - TICK_S < k * FRAME_S + latency_s <= now_s:
                state = TIMELINE.accept(plan(k * FRAME_S, rng.uniform(0, 1, (horizon, MOTION_DIM))), state)
        asked.append(now_s + min(lead_s, TIMELINE.lead_limit_s(state)))
        _, state = TIMELINE.sample(np.array([asked[-1]]), now_s, state)
    return np.array(asked), state


@given(
    st.sampled_from([(8, 4), (8, 1), (8, 6), (1, 1)]), st.sampled_from([0.002, 0.007, 0.013, 0.029]), st.floats(0, 0.25)
)
def test_a_lead_is_cut_to_what_is_left_of_plans_and_no_further(plans, latency_s, lead_s):
    asked, state = led(*plans, latency_s, lead_s)
    left_s = min(horizon_left_s(*plans, latency_s), LEAD_S)
    settled = (asked - TICK_S * np.arange(len(asked)))[300:]
    assert (settled >= min(lead_s, max(left_s, 0.0)) - 1e-6).all()
    assert (settled <= min(lead_s, max(left_s, 0.0) + TICK_S) + 1e-6).all()
    steps = np.diff(asked)
    assert (steps > 0.7 * TICK_S).all() and (steps < 1.3 * TICK_S).all()  # time neither jumps nor stands still


def test_a_listener_that_hangs_for_a_while_gets_its_lead_back():
    state = TIMELINE.start()
    for tick in range(3000):
        now_s = tick * TICK_S
        if tick % 4 == 0 and not 300 < tick < 600:
            state = TIMELINE.accept(plan(now_s, motions(8)), state)
        _, state = TIMELINE.sample(np.array([now_s]), now_s, state)
    assert TIMELINE.lead_limit_s(state) == LEAD_S
