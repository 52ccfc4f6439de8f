"""Evidence frame by frame is evidence of the whole; what comes later changes nothing; what is unknown says nothing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import FRAME_S, ListenerEvent
from sfms_robot.lab.evaluation.whole_recordings import Scene, done_at, heard_in, one_voice
from sfms_robot.listeners.events import evidence

FRAMES = 600
ASIDE = (0.2, -0.1)


def runs(rng, frames, mean):
    """(frames,) a flag that changes every `mean` frames or so."""
    changes = rng.random(frames) < 1 / mean
    return (np.cumsum(changes) + rng.integers(2)) % 2 == 1


def scene(seed, people=3, frames=FRAMES):
    rng = np.random.default_rng(seed)
    speaks = np.stack([runs(rng, frames, rng.choice([4, 30, 80])) for _ in range(people)], axis=1)
    looks = np.stack([runs(rng, frames, 40) for _ in range(people)], axis=1).astype(float)
    looks[:, rng.integers(people)] = np.nan
    looks[runs(rng, frames, 100)] = np.nan
    laughs, nods = (rng.random(frames) < 0.01 for _ in range(2))
    return Scene(speaks, looks, laughs, nods, rng.random(frames) * runs(rng, frames, 30))


def streamed(one):
    state, rows = evidence.hearing(one.speaks.shape[1]), []
    for index in range(len(one.speaks)):
        instant = evidence.Instant(
            speaks=tuple(one.speaks[index].tolist()), looks=tuple(one.looks[index].tolist()),
            laughs=bool(one.laughs[index]), nods=bool(one.nods[index]), smiles=float(one.smiles[index]),
        )  # fmt: skip
        row, state = evidence.hear(instant, state)
        rows.append(row)
    return np.array(rows)


@given(st.integers(0, 10**6), st.integers(2, 4))
def test_stream_equals_offline(seed, people):
    one = scene(seed, people)
    np.testing.assert_array_equal(streamed(one), heard_in(one))


def value(rows, name, at=-1):
    return rows[at, evidence.AT[name]]


def plain(speaks, looks=None):
    speaks = np.asarray(speaks, bool)
    none = np.zeros(len(speaks), bool)
    return Scene(speaks, np.full(speaks.shape, np.nan) if looks is None else looks, none, none, none)


def test_the_floor_is_of_whoever_spoke_for_a_second_last():
    mine = np.r_[np.zeros(60, bool), np.ones(30, bool), np.zeros(60, bool)]
    theirs = np.r_[np.ones(50, bool), np.zeros(70, bool), np.ones(30, bool)]
    rows = heard_in(plain(np.stack([mine, theirs], axis=1)))
    assert value(rows, "floor_mine", 30) == 0 and value(rows, "floor_s", 30) == pytest.approx(6 * FRAME_S)
    assert value(rows, "floor_mine", 90) == 1 and np.isnan(value(rows, "floor_s", 90))
    assert value(rows, "floor_mine") == 0 and value(rows, "holder_silence_s") == 0


def test_only_the_look_of_the_speaker_or_the_holder_counts():
    speaks = np.zeros((100, 3), bool)
    speaks[:40, 1] = True
    looks = np.tile([np.nan, 0.0, 1.0], (100, 1))
    rows = heard_in(plain(speaks, looks))
    assert value(rows, "gaze_known") == 1 and value(rows, "looked_at") == 0
    looks[50:] = [np.nan, 1.0, 0.0]
    rows = heard_in(plain(speaks, looks))
    assert value(rows, "looked_at") == 1 and value(rows, "looked_at_s") == pytest.approx(49 * FRAME_S)
    assert value(rows, "looked_at_silence_s") == value(rows, "silence_s")


def test_unknown_looks_are_no_evidence():
    one = scene(3)
    blind = Scene(one.speaks, np.full_like(one.looks, np.nan), one.laughs, one.nods, one.smiles)
    rows = heard_in(blind)
    assert not rows[:, [evidence.AT["gaze_known"], evidence.AT["looked_at"]]].any()
    assert np.isnan(rows[:, [evidence.AT["looked_at_s"], evidence.AT["looked_at_silence_s"]]]).all()


def test_one_voice_has_the_phrases_of_all_and_the_look_of_the_one_who_speaks():
    one, at = scene(3), evidence.AT
    several, merged = heard_in(one), heard_in(one_voice(one))
    phases, speaks = [at[name] for name in ("phrase_s", "silence_s", "last_phrase_s")], one.speaks[:, 1:].any(axis=1)
    np.testing.assert_array_equal(several[:, phases], merged[:, phases])
    np.testing.assert_array_equal(several[speaks, at["looked_at"]], merged[speaks, at["looked_at"]])
    assert several[:, at["several_speak"]].any() and not merged[:, at["several_speak"]].any()


KINDS = ("nod", "shake", "laugh", "smile", "mm_hm", "brow_raise", "blink", "tilt")


def deeds(seed):
    """Spans by kind in 100 s, and which gaze shifts go aside."""
    rng, spans = np.random.default_rng(seed), {}
    for kind in KINDS:
        starts = np.sort(rng.uniform(0, 100, rng.integers(0, 30)).round(2))
        spans[kind] = np.stack([starts, starts + rng.uniform(0.1, 2.0)], axis=1)
    at = np.unique(rng.uniform(0, 100, rng.integers(1, 20)).round(2))
    spans["gaze_shift"] = np.stack([at, np.r_[at[1:], 100.0]], axis=1)
    return spans, rng.random(len(at)) < 0.5


def as_events(spans, aside):
    events = [
        ListenerEvent(kind, start, end - start, 0.1, target_rad=None if kind != "gaze_shift" else (0.0, 0.0))
        for kind, rows in spans.items() if kind != "gaze_shift" for start, end in rows.tolist()
    ]  # fmt: skip
    events += [
        ListenerEvent("gaze_shift", start, end - start, 0.1, target_rad=ASIDE if away else (0.0, 0.0))
        for (start, end), away in zip(spans["gaze_shift"].tolist(), aside, strict=True)
    ]
    return sorted(events, key=lambda event: event.start_s)


@given(st.integers(0, 10**6))
def test_done_one_by_one_equals_done_in_whole(seed):
    spans, aside = deeds(seed)
    events = as_events(spans, aside)
    whole = done_at(spans, (np.arange(2500) + 1) * FRAME_S, 0.8, aside)
    for frame in range(0, 2500, 37):
        now_s = (frame + 1) * FRAME_S
        begun = [event for event in events if event.start_s < now_s - evidence.EPS_S]
        row, kept = (evidence.done(each, now_s, 0.8) for each in (begun, evidence.remembered(begun, now_s)))
        expected = whole[frame].copy()
        times = [index for index, name in enumerate(evidence.DONE) if name not in evidence.NUMBERS]
        for rows in (row, kept, expected):
            rows[times] = np.where(rows[times] > evidence.REMEMBERED_S - 2.1, np.inf, rows[times])
        np.testing.assert_allclose(row, expected, atol=1e-9)
        np.testing.assert_allclose(kept, expected, atol=1e-9)
