"""What spoils a voice or a face keeps its length and bounds; counts become rates and scatter."""

from pathlib import Path

import numpy as np
import pytest

from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_SAMPLES, ListenerEvent
from sfms_robot.lab.corpora.clips import split_of_voice
from sfms_robot.lab.evaluation import robustness
from sfms_robot.lab.evaluation.rollout import Rollout, rollout
from sfms_robot.listeners.registry import load_listener

VOICE = (0.1 * np.sin(np.arange(3 * AUDIO_HZ) * 0.3)).astype(np.float32)
FACE = np.full((3 * FRAME_HZ, 58), 0.2, np.float32)
SPEAKER = robustness.UnseenSpeaker("someone", VOICE, FACE)
PLAIN, *_, FLICKER = robustness.CONDITIONS


@pytest.mark.parametrize("condition", robustness.CONDITIONS, ids=lambda condition: condition.name)
def test_whatever_is_spoilt_stays_a_voice_and_a_face(condition):
    rng = np.random.default_rng(1)
    for spoil, given in ((condition.voice, VOICE), (condition.face, FACE)):
        if spoil is not None:
            before, after = given.copy(), spoil(given, rng)
            assert after.shape == given.shape and after.dtype == np.float32
            np.testing.assert_array_equal(given, before)
            assert not np.array_equal(after, given) or spoil.__name__ == "constant"
    if condition.voice is not None:
        after = condition.voice(VOICE, rng)
        assert np.isfinite(after).all() and np.abs(after).max() <= 1


def test_each_way_is_played_where_it_changes_something():
    every = [(inputs, robustness.CONDITIONS[number]) for inputs, number in robustness.cases()]
    assert len(every) == len({(inputs, how.name) for inputs, how in every})
    assert all((inputs, PLAIN) in every for inputs in ("voice", "face", "both"))
    assert {how for inputs, how in every if inputs == "both"} == set(robustness.CONDITIONS)
    for inputs, how in every:
        assert inputs != "voice" or (how.face is None and how is not FLICKER)
        assert inputs != "face" or how.voice is None


def test_a_short_recording_begins_again_and_what_is_not_an_input_is_not_there():
    frames = robustness.heard_and_seen(SPEAKER, "both", PLAIN, 0.1, np.random.default_rng(1))
    assert len(frames) == 6 * FRAME_HZ
    np.testing.assert_array_equal(frames[75].audio, frames[0].audio)
    assert frames[0].attention == 1.0 and frames[149].face is not None
    voice = robustness.heard_and_seen(SPEAKER, "voice", PLAIN, 0.1, np.random.default_rng(1))
    face = robustness.heard_and_seen(SPEAKER, "face", PLAIN, 0.1, np.random.default_rng(1))
    assert all(frame.face is None and frame.attention is None for frame in voice)
    assert all(not len(frame.audio) and frame.face is not None for frame in face)


def test_counts_become_rates_of_listening_and_their_scatter():
    nod = ListenerEvent("nod", 1.0, 0.5, 0.1)
    found = robustness.counted(
        Rollout(np.zeros((2, 500, 58), np.float32), np.zeros((2, 500), np.int8), ((nod, nod), (nod,)))
    )
    assert found == {"nod": [0, 0], "blink": [0, 0], "smile": [0, 0], "decided_nod": [2, 1]}
    found = robustness.rates({"nod": [4, 6, 5, 5], "smile": [0, 0, 0, 0]}, minutes=2.0, listened=2.0)
    assert found["nods_per_minute"] == 2.5 and found["nods_variance_over_mean"] == pytest.approx(0.667 / 5, abs=1e-3)
    assert found["smiles_per_minute"] == 0 and found["smiles_variance_over_mean"] is None
    found = robustness.rates({"nod": [4, 4], "decided_nod": [2, 2], "blink": [8, 8]}, minutes=2.0, listened=0.5)
    assert [found[f"{kind}s_per_minute"] for kind in ("nod", "decided_nod", "blink")] == [8.0, 4.0, 4.0]


def test_what_people_do_not_do_is_named_but_nobody_has_to_answer_whom_nothing_tells_to_speak():
    row = {"nods_per_minute": 21.0, "blinks_per_minute": 15.0, "smiles_per_minute": 0.0}
    assert robustness.outside(row) == ["nods_per_minute", "smiles_per_minute"]
    row = {"nods_per_minute": 0.0, "blinks_per_minute": 15.0, "smiles_per_minute": 0.0}
    assert robustness.outside(row) and not robustness.outside(row, tells_speech=False)
    assert robustness.outside(row | {"blinks_per_minute": 0.0, "nods_per_minute": 9.0}, tells_speech=False) == [
        "nods_per_minute",
        "blinks_per_minute",
    ]
    assert {how.name for how in robustness.CONDITIONS if not how.mouth_moves} == {"face constant", "face saturated"}


LIES = ("face constant", "face saturated", "face upside down", "face lost", "attention flickers")
MINUTES = 0.4
MOST = {"nod": 15.0, "blink": 30.0, "smile": 4.0}  # a minute, of people who are talked to and looked at, twice as many


def test_bundled_speakers_that_are_kept_for_test_have_a_face_as_long_as_their_voice():
    speakers = robustness.unseen(robustness.voice_folders(None))
    assert speakers and all(split_of_voice(speaker.name) == "test" for speaker in speakers)
    for speaker in speakers:
        assert np.isfinite(speaker.face).all() and len(speaker.face) == len(speaker.voice) // FRAME_SAMPLES > 250


def test_folders_without_such_a_voice_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such folder"):
        robustness.voice_folders(Path(tmp_path / "gone"))
    with pytest.raises(ConfigError, match=f"{tmp_path.name}: no WAV or FLAC file to take voices from"):
        robustness.unseen((tmp_path,))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sfms-small", "arig-small"])
@pytest.mark.parametrize("lie", [one for one in robustness.CONDITIONS if one.name in LIES], ids=lambda one: one.name)
def test_a_face_that_lies_and_attention_that_flickers_bring_no_storm(name, lie):
    """In the motion itself, beside a voice that is as it was."""
    (speaker, *_), rng = robustness.unseen(robustness.voice_folders(None)), np.random.default_rng(1)
    frames = robustness.heard_and_seen(speaker, "both", lie, MINUTES, rng)
    played = rollout(load_listener(find("listeners", name, "config.yaml")), frames, range(2))
    for kind, numbers in robustness.counted(played).items():
        assert np.mean(numbers) / MINUTES <= MOST.get(kind.removeprefix("decided_"), 60.0), kind
    assert np.isfinite(played.motion).all()
