"""Whole recordings at once say what frame by frame says."""

import numpy as np
import pytest

from sfms_robot.config import Calmness
from sfms_robot.frames import CHANNEL_INDEX, EVENT_KINDS, FRAME_S, FRAME_SAMPLES, FaceFrame, ListenerEvent, SpeakerFrame
from sfms_robot.lab.evaluation.whole_recordings import hazards_in, heard_in, most_in, scene_in, steps_in
from sfms_robot.listeners.events.evidence import EPS_S, HEARD, Sensed, sense
from sfms_robot.listeners.events.model import EventModel, changed

FRAMES = 4000
CALMNESS = [Calmness(), Calmness(nod=6.0, blink=0, addressed="assume")]


@pytest.fixture(scope="module")
def speaker():
    """Somebody who talks, nods, smiles, looks and looks away, is lost now and then; we say a word between."""
    rng = np.random.default_rng(4)
    talks, looks, says = (np.repeat(rng.random(FRAMES // each) < share, each) for each, share in
                          ((40, 0.6), (50, 0.5), (20, 0.1)))  # fmt: skip
    frames = []
    for index in range(FRAMES):
        motion = np.zeros(58, np.float32)
        motion[CHANNEL_INDEX["pitch"]] = 0.08 * np.sin(index / 5) * (index % 300 < 40)
        motion[CHANNEL_INDEX["jawOpen"]] = 0.3 * talks[index] * (index % 5 > 2)
        smiles = 0.7 * (index % 700 < 60)
        motion[[CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["mouthSmileRight"]]] = smiles
        time_s = (index + 1) * FRAME_S
        face = None if index % 900 < 60 else FaceFrame.of(time_s, motion)
        audio, own = rng.standard_normal((2, FRAME_SAMPLES)).astype(np.float32) * np.float32(0.1)
        loud = np.float32(1 if talks[index] else 1e-3)
        looked = None if index % 1500 < 100 else np.nan if index % 800 < 50 else float(looks[index])
        frames.append(SpeakerFrame(time_s, audio * loud, face, own if says[index] else None, looked))
    return frames


@pytest.fixture(scope="module")
def history():
    """Of every kind some, one after the other; looks aside and back; some begin as a frame ends."""
    rng, events = np.random.default_rng(5), []
    for kind in EVENT_KINDS:
        for number, start_s in enumerate(np.sort(rng.uniform(0, FRAMES * FRAME_S, 12)).round(2)):
            target = None if kind != "gaze_shift" else (0.3, 0.0) if number % 2 == 0 else (0.0, 0.0)
            events.append(ListenerEvent(kind, float(start_s), float(rng.uniform(0.2, 3)), 0.1, target_rad=target))
    events += [ListenerEvent("nod", 4.0, 0.4, 0.1), ListenerEvent("blink", 8.0, 0.2, 1.0)]
    return sorted(events, key=lambda event: event.start_s)


@pytest.fixture(scope="module")
def rows(speaker):
    memory, found = EventModel.load().start(0).sensed, []
    for frame in speaker:
        one, memory = sense(frame, memory)
        found.append(one)
    return found


@pytest.mark.parametrize("addressed", ["sense", "assume", "never"])
def test_a_scene_has_the_evidence_of_every_frame(speaker, addressed):
    memory = EventModel.load().start(0, Calmness(addressed=addressed)).sensed
    found = heard_in(scene_in(speaker, addressed))
    for row, frame in zip(found, speaker, strict=True):
        one, memory = sense(frame, memory)
        np.testing.assert_array_equal(row, one.heard)


def test_a_scene_without_a_microphone_hears_with_its_eyes_and_nothing_is_asked_of_nothing(speaker):
    deaf = [SpeakerFrame(frame.time_s, np.zeros(0, np.float32), frame.face) for frame in speaker[:600]]
    assert scene_in(deaf).speaks[:, 1].any()
    model = EventModel.load()
    for frames in (0, 1, 2):
        found = hazards_in(model, np.full((frames, len(HEARD)), np.nan), [], Calmness())
        assert {len(values) for values in found.values()} == {frames}
        assert not model.decide_each([Sensed(0, np.full(len(HEARD), np.nan))], [model.start(0)])[0][0]


@pytest.mark.parametrize("calmness", CALMNESS)
def test_hazards_are_those_asked_frame_by_frame(rows, history, calmness):
    model = EventModel.load()
    found = hazards_in(model, np.stack([one.heard for one in rows]), history, calmness)
    memory = model.start(0, calmness)
    for index, one in enumerate(rows):
        begun = tuple(event for event in history if event.start_s < (index + 1) * FRAME_S - EPS_S)
        ((_, memory),) = model.decide_each([one], [changed(memory, done=begun)])
        for kind, hazard_hz in memory.hazards_hz.items():
            assert found[kind][index] == pytest.approx(hazard_hz, abs=1e-9), (kind, index)


def test_no_history_makes_anything_likelier_than_the_most(rows, history):
    model, heard, steps = EventModel.load(), np.stack([one.heard for one in rows]), steps_in(FRAMES)
    for calmness in CALMNESS:
        most = most_in(model, heard[steps], calmness)
        for own in (history, [event for event in history if event.kind == "nod"], []):
            found = hazards_in(model, heard, own, calmness)
            for at, kind in enumerate(model.bank.kinds):
                assert (found[kind][steps] * 0.08 <= most[:, at]).all(), kind
    assert most[:, model.bank.kinds.index("blink")].max() == 0, "never, at no rate"
