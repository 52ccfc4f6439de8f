"""Laws of drawing tokens: courses of smiles and nods, ramps that begin when they are known, and reach."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_sfms import plans_of, speech, tiny_listener, told_listener

from sfms_robot.config import NodCourse, SmileCourse, find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, POSE_CHANNELS, SMILE_CORNERS, ListenerEvent
from sfms_robot.lab.evaluation.detection import Detected, added_up, asked_and_seen
from sfms_robot.lab.evaluation.rollout import rollout
from sfms_robot.listeners.registry import at_hop, load_listener
from sfms_robot.listeners.sfms import draw
from sfms_robot.signals.control import COLUMNS, control_track

SMILE = ListenerEvent("smile", 0.6, 2.4, 0.5)
LAUGH = ListenerEvent("laugh", 1.0, 1.0, 0.8)
CODES = np.linspace(0, 1, 11)
HOW = SmileCourse(spread=0.1)
NODDING = NodCourse(spread=0.06)
FACE = [name for name in BLENDSHAPES if not name.startswith("eyeLook")]


def told(*events, how: SmileCourse = HOW):
    return draw.smile_course(how, control_track(events, 0, 90)).wanted


def test_a_smile_rises_to_its_size_and_without_one_or_in_a_laugh_nothing_is_wanted():
    wanted, times_s = told(SMILE), (1 + np.arange(90)) * 0.04
    under_way = (times_s >= SMILE.start_s - 1e-6) & (times_s < SMILE.end_s - 1e-6)
    np.testing.assert_array_equal(np.isfinite(wanted), under_way)
    shown = wanted[under_way]
    peak = int(shown.argmax())
    assert (np.diff(shown[: peak + 1]) >= -1e-6).all() and (np.diff(shown[peak:]) <= 1e-4).all()
    assert shown.max() == pytest.approx(SMILE.size, rel=1e-3) and shown[0] < 0.05 and shown[-1] < 0.05
    nod = ListenerEvent("nod", 0.2, 1.0, 0.1, swings=2)
    assert np.isnan(told(nod)).all() and np.isnan(told()).all()
    both = told(SMILE, LAUGH)
    laughing = control_track([LAUGH], 0, 90)[:, COLUMNS.index("laugh.active")] > 0
    assert np.isnan(both[laughing]).all() and np.isfinite(both[~laughing & np.isfinite(told(SMILE))]).all()


def test_a_code_loses_the_more_the_further_it_lies_from_the_course():
    """The transition as much as the code that is held; with none held, as one at rest."""
    wanted = np.array([np.nan, 0.5, 0.5, 0.2])
    smiling, lost = draw.EventCourse(HOW, 1, CODES).penalties(wanted, np.full(4, 0.1), np.array([0, 6, 0, 3]))
    assert smiling.tolist() == [1, 2, 3] and lost.shape == (3, 12) and (lost >= 0).all()
    np.testing.assert_allclose(lost[0, 1:], (CODES - 0.5) ** 2 / 0.02, rtol=1e-5)
    np.testing.assert_allclose(lost[:, 0], [lost[0, 6], lost[1, 1], lost[2, 3]])


@given(st.floats(0.2, 2), st.integers(1, 4), st.floats(0.3, 0.66), st.floats(0.03, 0.2))
def test_a_nod_goes_to_its_size_at_each_swing_less_and_comes_back(start_s: float, swings: int, each_s: float, size):
    nod = ListenerEvent("nod", start_s, swings * each_s, size, swings)
    course = draw.nod_course(NODDING, control_track([nod], 0, 150))
    rows = np.flatnonzero(np.isfinite(course.wanted))
    since_s = (rows + 1) * 0.04 - start_s
    assert since_s.min() > 0 and since_s.max() < nod.duration_s + 0.04
    turns = course.wanted[rows]
    assert turns.max() == pytest.approx(size, rel=1e-3) and turns.min() == 0
    for swing in range(swings):
        lowest = turns[(since_s > swing * each_s) & (since_s <= (swing + 1) * each_s)].max()
        assert lowest == pytest.approx(size * NODDING.fall**swing, rel=1e-3)
    off_s = np.abs(since_s[turns == 0][:, None] - each_s * np.arange(1, swings + 1))
    assert off_s.min(axis=1).max() <= 0.0201 and off_s.min(axis=0).max() <= 0.0201
    np.testing.assert_allclose(course.spread[rows], NODDING.spread * size, rtol=1e-5)


def corners(plans) -> np.ndarray:
    at = [CHANNEL_INDEX[name] for name in SMILE_CORNERS]
    return np.array([plan.frames[0, at].mean() for plan in plans.values()])


def test_a_narrow_course_is_kept_to_by_any_weights_and_smiles_not_told_are_as_they_were():
    """As near as codes allow; without one untrained weights smile at nothing."""
    how = {"smile": {"spread": 0.01}, "reach": False}
    before, after = (
        corners(plans_of(told_listener(hop=1, **how_), speech(70), events=[SMILE])) for how_ in ({}, {"sampling": how})
    )
    plateau = np.flatnonzero(told(SMILE)[1:71] > 0.95 * SMILE.size)
    assert np.abs(after[plateau] - SMILE.size).mean() < np.abs(before[plateau] - SMILE.size).mean()
    plain, steered = told_listener(hop=2), told_listener(hop=2, sampling={"smile": {"spread": 0.1}})
    nod = ListenerEvent("nod", 0.8, 0.8, 0.1, swings=2)
    before, after = (plans_of(one, speech(50), events=[nod]) for one in (plain, steered))
    for index, plan in before.items():
        np.testing.assert_array_equal(after[index].frames, plan.frames)


@pytest.mark.parametrize(
    "smile, text",
    [
        ({"spread": 0.0}, "spread"),
        ({"spread": 0.1, "rise": [0.0, 1.0]}, "rise: 2 shares, 8 are needed"),
        ({"spread": 0.1, "fall": [0.0]}, "fall: 1 shares, 7 are needed"),
    ],
)
def test_a_course_that_is_none_is_refused(smile, text):
    with pytest.raises(ConfigError, match=text):
        told_listener(sampling={"smile": smile})


def test_a_listener_that_cannot_keep_to_one_says_so():
    for kind in ("nod", "smile"):
        with pytest.raises(ConfigError, match=f"sampling.{kind}: expected events: true, without which .* no {kind}"):
            tiny_listener(sampling={kind: {"spread": 0.1}})
    head, face = [*POSE_CHANNELS, SMILE_CORNERS[0]], [name for name in FACE if name != SMILE_CORNERS[0]]
    group = {"levels": (3, 2), "keyframe_cost": 1.0}
    apart = {"one": group | {"channels": head}, "other": group | {"channels": face}}
    with pytest.raises(ConfigError, match="sampling.smile: no group holds both of mouthSmileLeft, mouthSmileRight"):
        told_listener(groups=apart, sampling={"smile": {"spread": 0.1}})


NOW, RAMP = 4, 4


def window(*tokens: int) -> np.ndarray:
    """(1, T, 1) of one group, the newest frame shown at `NOW`."""
    return np.array(tokens)[None, :, None]


def now_of(tokens: np.ndarray, before: np.ndarray) -> int:
    found = draw.anchored(tokens, before == draw.UNDECIDED, np.array([NOW]), RAMP)
    rest = np.arange(tokens.shape[1]) != NOW
    np.testing.assert_array_equal(found[:, rest], tokens[:, rest])
    return int(found[0, NOW, 0])


def test_what_was_held_or_stands_at_the_newest_frame_is_a_keyframe_and_without_any_before_there_is_none():
    assert now_of(window(0, 7, 0, 0, 0, 0, 3, 0, 0), window(0, 7, 0, 0, 0, -1, -1, -1, -1)) == 7
    assert now_of(window(0, 7, 0, 0, 5, 0, 3, 0, 0), window(0, 7, 0, 0, 5, -1, -1, -1, -1)) == 5
    assert now_of(window(0, 0, 0, 0, 0, 0, 3, 0, 0), window(0, 0, 0, 0, 0, -1, -1, -1, -1)) == 0


@pytest.mark.parametrize(
    "tokens, before",
    [
        ((0, 7, 0, 0, 0, 0, 0, 0, 3), (0, 7, 0, 0, 0, -1, -1, -1, -1)),  # its ramp begins later by itself
        ((0, 7, 0, 0, 0, 0, 3, 0, 2), (0, 7, 0, 0, 0, 0, 3, -1, -1)),  # on its way already
        ((0, 7, 0, 0, 0, 0, 0, 0, 0), (0, 7, 0, 0, 0, -1, -1, -1, -1)),  # none
    ],
)
def test_where_no_ramp_begins_anew_nothing_changes(tokens, before):
    assert now_of(window(*tokens), window(*before)) == 0


def test_groups_and_streams_are_each_by_itself():
    tokens = np.stack([window(0, 7, 0, 0, 0, 0, 3, 0, 0)[0, :, 0], np.zeros(9, int)], axis=1)
    both = np.stack([tokens, tokens[:, ::-1]])
    found = draw.anchored(both, np.arange(9)[None, :, None] > NOW + 0 * both, np.array([NOW, NOW]), RAMP)
    np.testing.assert_array_equal(found[:, NOW], [[7, 0], [0, 7]])


def test_a_ramp_begins_no_earlier_than_what_it_was_told_for():
    """Frames that are kept show what they showed: a ramp to a keyframe behind them begins at the last of them."""
    tokens = np.concatenate([window(0, 7, 0, 0, 0, 0, 0, 0, 3)] * 3)
    told = np.zeros((3, 9, 1), np.float32)
    told[0, NOW + 3 :] = told[1, NOW + 1 :] = 1.0
    kept, settled = draw.revoked(tokens, np.zeros_like(told), told, 4)
    assert settled.tolist() == [NOW + 2, NOW + 1, NOW]  # the next frame is kept, whatever is told; nothing told anew
    drawn = np.where(kept == draw.UNDECIDED, window(0, 0, 0, 0, 0, 0, 0, 0, 3), kept)
    found = draw.anchored(drawn, kept == draw.UNDECIDED, settled, RAMP)
    assert ["".join(map(str, row)) for row in found[:, :, 0].tolist()] == ["070000703", "070007003", "070000003"]


@pytest.mark.parametrize("hop", [pytest.param(1, marks=pytest.mark.slow), 2, 4])
def test_nods_come_out_as_told_and_when(hop: int):
    """Of every length and size that are decided: the shipped listener, told of them in silence."""
    listener = at_hop(load_listener(find("listeners", "sfms-small", "config.yaml")), hop).how
    made_s = [(each_s, swings) for each_s in (0.3, 0.4, 0.55) for swings in (1, 2, 3)]
    nods = [
        ListenerEvent("nod", 2.0 + 3.0 * at, each_s * swings, np.radians(5.0 if at % 2 else 4.0), swings)
        for at, (each_s, swings) in enumerate(made_s)
    ]
    motions = rollout(listener, speech(round(25 * (nods[-1].end_s + 2))), [1, 2, 3], nods).motion
    seen = added_up(asked_and_seen(nods, Detected.of(motion), {"nod": -0.06}) for motion in motions)["nod"]
    assert seen.recall >= 26 / 27 and seen.precision >= 26 / 27
    pitch = np.degrees(motions[..., CHANNEL_INDEX["pitch"]])
    made = [np.ptp(pitch[:, round(25 * nod.start_s) - 2 : round(25 * nod.end_s) + 2], axis=1) for nod in nods]
    assert 0.85 < np.median(np.array(made) / np.degrees([[nod.size] for nod in nods])) < 1.15


def listener_with_speed(speed: float, bounded: bool = True):
    listener = tiny_listener(sampling={"reach": bounded})
    listener.model.motion_speed.fill_(speed)
    codes = listener.engine.run("rest", np.zeros((1, 40, 58), np.float32), np.zeros((1, 40, 2), np.float32))[1][0]
    return listener.model, draw.CodeReach(listener.settings, codes, listener.engine.tensors["motion_speed"])


def test_a_code_may_follow_itself_class_0_anything_and_without_bounds_every_code():
    _, reach = listener_with_speed(1e-6)
    for code in range(1, 7):
        allowed = ~reach.too_soon(np.array([[code, code]]), np.array([[1, 1]]))[0]
        assert allowed[:, 0].all() and allowed[:, code].all()
    _, reach = listener_with_speed(1e-6, bounded=False)
    assert (~reach.too_soon(np.array([[1, 1]]), np.array([[1, 1]])))[0].sum(1).tolist() == [7, 9]


def test_allowed_codes_are_exactly_those_no_channel_has_to_hurry_for():
    model, reach = listener_with_speed(0.1)
    quantizer = model.tokenizer.quantizer
    neck = quantizer.decode(quantizer.codebook.codes(torch.arange(6)[:, None].expand(6, 2))[None])[0, :, :6].detach()
    for gap in (1, 5, 20):
        allowed = ~reach.too_soon(np.array([[3, 0]]), np.array([[gap, gap]]))[0, 0, 1:7]
        np.testing.assert_array_equal(allowed, ((neck - neck[2]).abs() <= 0.1 * gap).all(-1))
