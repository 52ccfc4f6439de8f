"""Speakers of the judge are those kept for test, each with a face; a folder that is not there is named."""

from pathlib import Path

import numpy as np
import pytest

from sfms_robot.app.evaluate.unseen_speakers import unseen, voice_folders
from sfms_robot.corpora.splits import split_of_voice
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES


def test_bundled_speakers_that_are_kept_for_test_have_a_face_as_long_as_their_voice():
    speakers = unseen(voice_folders(None))
    assert speakers and all(split_of_voice(speaker.name) == "test" for speaker in speakers)
    for speaker in speakers:
        assert speaker.face is not None and np.isfinite(speaker.face).all()
        assert len(speaker.face) == len(speaker.voice) // FRAME_SAMPLES > 250


def test_folders_without_such_a_voice_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such folder"):
        voice_folders(Path(tmp_path / "gone"))
    with pytest.raises(ConfigError, match=f"{tmp_path.name}: no WAV file"):
        unseen((tmp_path,))
