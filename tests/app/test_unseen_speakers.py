"""Speakers of the judge are those kept for test, each with a face; a face that lies brings no storm of events."""

from pathlib import Path

import numpy as np
import pytest

from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES
from sfms_robot.lab.corpora.splits import split_of_voice
from sfms_robot.lab.evaluate.unseen_speakers import unseen, voice_folders
from sfms_robot.lab.evaluation.robustness import CONDITIONS, counted, heard_and_seen
from sfms_robot.lab.evaluation.rollout import rollout
from sfms_robot.listeners.registry import load_listener

LIES = ("face constant", "face saturated", "face upside down", "face lost", "attention flickers")
MINUTES = 0.4
MOST = {"nod": 15.0, "blink": 30.0, "smile": 4.0}  # a minute, of people who are talked to and looked at, twice as many


def test_bundled_speakers_that_are_kept_for_test_have_a_face_as_long_as_their_voice():
    speakers = unseen(voice_folders(None))
    assert speakers and all(split_of_voice(speaker.name) == "test" for speaker in speakers)
    for speaker in speakers:
        assert speaker.face is not None and np.isfinite(speaker.face).all()
        assert len(speaker.face) == len(speaker.voice) // FRAME_SAMPLES > 250


def test_folders_without_such_a_voice_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such folder"):
        voice_folders(Path(tmp_path / "gone"))
    with pytest.raises(ConfigError, match=f"{tmp_path.name}: no WAV or FLAC file to take voices from"):
        unseen((tmp_path,))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sfms-small", "arig-small"])
@pytest.mark.parametrize("lie", [one for one in CONDITIONS if one.name in LIES], ids=lambda one: one.name)
def test_a_face_that_lies_and_attention_that_flickers_bring_no_storm(name, lie):
    """In the motion itself, beside a voice that is as it was."""
    (speaker, *_), rng = unseen(voice_folders(None)), np.random.default_rng(1)
    played = rollout(
        load_listener(find("listeners", name, "config.yaml")),
        heard_and_seen(speaker, "both", lie, MINUTES, rng),
        range(2),
    )
    for kind, numbers in counted(played).items():
        assert np.mean(numbers) / MINUTES <= MOST.get(kind.removeprefix("decided_"), 60.0), kind
    assert np.isfinite(played.motion).all()
