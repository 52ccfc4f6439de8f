"""What `run --audio mic --check` says of what it heard."""

import numpy as np
import pytest

from sfms_robot.app.listen.sound_check import check_sound, judge_sound
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES


def frames_of(speech, noise, count=75):
    """Noise, and speech in a third of the frames; peaks of that size."""
    rng = np.random.default_rng(0)
    loud = [speech if index % 3 == 0 else 0.0 for index in range(count)]
    return [
        np.clip(rng.normal(0.0, max(size, noise) / 3, FRAME_SAMPLES), -1, 1).astype(np.float32) if max(size, noise)
        else np.zeros(FRAME_SAMPLES, np.float32)
        for size in loud
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("speech", "noise", "finding"),
    [
        (0.3, 0.003, None),
        (0.3, 0.2, "dB above the noise, 10 are needed"),
        (0.003, 0.0005, "very quiet"),
        (0.0, 0.0, "digital silence"),
        (4.0, 0.003, "of the samples clip"),
    ],
)
def test_what_is_not_as_it_should_be_is_found(speech, noise, finding):
    told = judge_sound(frames_of(speech, noise))
    assert len(told["findings"]) == (finding is not None)
    assert finding is None or finding in told["findings"][0]


def test_levels_are_those_of_speech_and_room_and_frames_that_did_not_come_are_said():
    told = judge_sound(frames_of(0.3, 0.003))
    assert told["level_dbfs"] == pytest.approx(-20.0, abs=0.5)
    assert told["noise_floor_dbfs"] == pytest.approx(-60.0, abs=0.5)
    assert told["seconds"] == 3.0 and told["missing_frames"] == 0 and told["clipped"] == 0.0
    nothing = np.zeros(0, np.float32)
    assert "nothing came" in judge_sound([nothing] * 75)["findings"][0]
    some = frames_of(0.3, 0.003)
    some[10] = some[20] = nothing
    assert judge_sound(some)["findings"] == ["2 frames of 40 ms did not come in time: the computer is too busy"]


def test_a_recorded_voice_can_be_checked_and_is_shown_as_it_comes():
    levels = []
    told = check_sound("katie", 0.4, lambda level_db, clips: levels.append((level_db, clips)))
    assert len(levels) == 10 and told["seconds"] == 0.4 and told["audio"] == "katie"
    with pytest.raises(ConfigError, match="--check: there is nothing to listen to"):
        check_sound("none")
