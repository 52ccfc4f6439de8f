"""When a robot speaks: as long as its own voice is played, by the clock of who plays it, whoever else talks."""

import numpy as np
import pytest
from loop_rig import Posed

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.frames import FRAME_S
from sfms_robot.runtime.clock import InlineFeed
from sfms_robot.runtime.states import TURN_GAP_S
from sfms_robot.signals.audio import AudioFile
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.push import PushedSpeech
from sfms_robot.sources.recording import RecordedVoice
from sfms_robot.sources.registry import shipped_speaker

TALKS_S = 6.0


class Told:
    """`ports.Outlet`: what a program would be told."""

    def __init__(self):
        self.heard, self.states = 0, []

    def hears(self, audio, time_s):
        self.heard += 1

    def tells(self, kind, time_s, **values):
        if kind == "state":
            self.states.append((values["state"], time_s))


def spoken(*sayings, person=True):
    """A run in which the robot says (samples, at_s) each, while somebody talks all the time; and what was told."""
    speech, told = PushedSpeech(lambda: 0.0), Told()
    for seconds, at_s in sayings:
        speech.say(0.3 * np.sin(np.arange(round(seconds * 16000)) / 9), 16000, at_s)
    speech.outlet = told
    voice = RecordedVoice(AudioFile(shipped_speaker("katie").audio)) if person else None
    source = PairedSource(voice, None, speech, TALKS_S)
    options = RunOptions(head="interbotix_wxxms", duration_s=TALKS_S, fast=True)
    report = run(options, source=source, feed=InlineFeed(Posed(), 0), signals=False)
    assert report["exit"] == "done"
    return told


def turns(told):
    """(from, to) of each time it was speaking."""
    return [(at_s, told.states[i + 1][1]) for i, (name, at_s) in enumerate(told.states[:-1]) if name == "speaking"]


def test_it_speaks_from_when_it_is_played_until_a_pause_after_it():
    """Handed over at 0 s, played at 2 s: not before. A frame's resolution, one frame early as the lips need it."""
    told = spoken((1.5, 2.0))
    ((begins_s, ends_s),) = turns(told)
    assert begins_s == pytest.approx(2.0, abs=0.06)
    assert ends_s == pytest.approx(3.5 + TURN_GAP_S, abs=0.08)
    assert told.heard == TALKS_S / FRAME_S
    assert [name for name, _ in told.states if name != "stopping"][-2:] == ["speaking", "listening"]


def test_a_pause_between_words_and_a_person_who_talks_do_not_end_its_turn():
    ((begins_s, ends_s),) = turns(spoken((0.5, 2.0), (0.5, 2.9)))
    assert (begins_s, ends_s) == (pytest.approx(2.0, abs=0.06), pytest.approx(3.4 + TURN_GAP_S, abs=0.08))


def test_with_nobody_there_it_is_idle_again():
    told = spoken((1.0, 2.0), person=False)
    assert [name for name, _ in told.states if name in ("idle", "speaking")] == ["idle", "speaking", "idle"]
    assert told.heard == 0
