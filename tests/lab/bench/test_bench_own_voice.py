"""A small version of `bench own-voice`, on one of the calls that ship."""

import pytest
import soundfile

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.lab.bench.own_voice_bench import CHOSEN_ON, VoiceCondition, call_names, own_voice

CALLS = data_dir("sim") / "conversations"


def test_calls_that_parameters_were_chosen_on_are_not_reported_on(tmp_path):
    for name in (CHOSEN_ON[0], "other"):
        (tmp_path / f"{name}_caller.flac").touch()
    assert call_names(tmp_path) == ["other"] and len(call_names(CALLS)) == 2
    with pytest.raises(ConfigError, match="has no NAME_caller"):
        call_names(tmp_path / "nothing")


def measured(folder, name, seconds, *conditions):
    """Measure on the beginning of a call."""
    pytest.importorskip("pyroomacoustics")
    for file in CALLS.glob(f"{name}_*.flac"):
        sound, rate_hz = soundfile.read(file)
        soundfile.write(folder / file.name, sound[: seconds * rate_hz], rate_hz)
    return own_voice(folder, conditions)


@pytest.mark.slow
def test_own_voice_is_not_the_person_and_the_person_is_heard(tmp_path):
    turns, over = VoiceCondition(own_db=0.0), VoiceCondition(own_db=0.0, talks_over=True)
    result = measured(tmp_path, call_names(CALLS)[0], 30, turns, over)
    in_turns, talking_over = result["conditions"]
    assert result["echo_latency_ms"] <= 10.0
    assert in_turns["own_voice_taken"] < 0.02 and in_turns["person_missed"] < 0.05
    assert talking_over["own_voice_taken"] < 0.05 and talking_over["person_missed_in_double_talk"] < 0.15


@pytest.mark.slow
def test_a_head_that_moves_hears_the_person_and_no_one_where_nobody_is(tmp_path):
    moving, alone = VoiceCondition(motors_db=0.0), VoiceCondition(motors_db=0.0, person=False)
    with_person, nobody = measured(tmp_path, call_names(CALLS)[0], 62, moving, alone)["conditions"]
    assert with_person["person_missed"] < 0.05 and with_person["nobody_taken"] < 0.02
    assert nobody["person_missed"] is None and nobody["nobody_taken"] < 0.02
