"""Kinds of voices and sights are found by name, imported when opened, and go together in every way."""

import subprocess
import sys
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.frames import SpeakerFrame
from sfms_robot.ports import Source
from sfms_robot.signals.audio import AudioFile
from sfms_robot.sources.paired import LONGEST_WAIT_S
from sfms_robot.sources.push import PushedSight, PushedVoice
from sfms_robot.sources.recording import RecordedVoice
from sfms_robot.sources.registry import KINDS, check_source, open_source, shipped_speaker, source_kinds

FACE = str(shipped_speaker("facegood_1114_3_16").face)


class Own(Source):
    closed = False

    def read(self, now_s):
        return [SpeakerFrame(0.0, np.zeros(0, dtype=np.float32))]

    def close(self):
        self.closed = True


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install kinds of another package by name; None: one whose module is not there."""

    def installed(**loaded):
        info = tmp_path / "theirs-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
        lines = [f"{name} = {'theirs' if value else 'nowhere'}:{name}" for name, value in loaded.items()]
        (info / "entry_points.txt").write_text("\n".join(["[sfms_robot.sources]", *lines]))
        monkeypatch.setitem(sys.modules, "theirs", SimpleNamespace(**loaded))
        monkeypatch.syspath_prepend(tmp_path)

    return installed


@pytest.mark.parametrize("audio", ["push:0", "katie", "none", "ear"])
@pytest.mark.parametrize("face", ["push:0", "none", FACE, "eye"])
@pytest.mark.parametrize("agent_audio", ["katie", "none"])
def test_any_voice_goes_with_any_face(install, audio, face, agent_audio):
    install(ear=lambda argument: PushedVoice(), eye=lambda argument: PushedSight())
    source = open_source(audio, face, 2.0, agent_audio=agent_audio)
    source.start(0.0)
    frames = source.read(2.0 + LONGEST_WAIT_S)
    assert [frame.time_s for frame in frames] == [index / 25 for index in range(1, 51)]
    assert all(len(frame.audio) == (640 if audio == "katie" else 0) for frame in frames)
    assert all((frame.agent_audio is not None) == (agent_audio == "katie") for frame in frames)
    source.close()


@pytest.mark.parametrize(
    ("audio", "face", "agent_audio", "duration_s"),
    [
        ("default", "push:0", "none", None),  # a face that is named goes without the default voice
        ("default", "none", "none", 47.68),
        ("none", FACE, "none", 47.6),
        ("none", "none", "none", None),
        ("katie", "push:0", "none", 18.36),  # a recording ends a run, also beside a live face
        ("push:0", "auto", "katie", None),
    ],
)
def test_a_run_lasts_as_long_as_its_recording(audio, face, agent_audio, duration_s):
    with closing(open_source(audio, face, agent_audio=agent_audio)) as source:
        assert source.duration_s == (duration_s and pytest.approx(duration_s))


def test_what_is_no_voice_or_no_face_or_brings_its_own_is_refused(install):
    inner = Own()
    install(person=lambda argument: inner, ear=lambda argument: PushedVoice(), eye=lambda argument: PushedSight())
    with pytest.raises(ConfigError, match="--face push: --audio person brings its own"):
        open_source("person", "push")
    assert inner.closed
    with pytest.raises(ConfigError, match="--audio eye: expected a voice or source from theirs:eye, got a PushedSight"):
        open_source("eye")
    with pytest.raises(ConfigError, match="--face ear: expected a face from theirs:ear, got a PushedVoice"):
        open_source("none", "ear")


def test_what_was_opened_is_closed_when_the_next_cannot_be(install):
    class Ear(RecordedVoice):
        closed = False

        def close(self):
            super().close()
            self.closed = True

    ear = Ear(AudioFile(shipped_speaker("katie").audio))
    install(ear=lambda argument: ear, broken=None)
    with pytest.raises(ConfigError, match="plug-in broken .*nowhere:broken.: ModuleNotFoundError"):
        open_source("ear", "broken")
    assert ear.closed


def test_kinds_of_other_packages_are_imported_when_opened_and_never_replace_ours(install):
    install(push=Own, broken=None)
    assert all(source_kinds(flag)["push"] is KINDS[flag]["push"] for flag in ("--audio", "--face"))
    check_source("broken")
    with pytest.raises(ConfigError, match="plug-in broken .package theirs, nowhere:broken.: ModuleNotFoundError: No"):
        open_source("broken")


@pytest.mark.parametrize("fault", [KeyError("ear"), OSError(19, "No such device"), SystemExit(1)])
def test_a_kind_that_raises_when_it_is_made_is_one_line(install, fault):
    def made(argument):
        raise fault

    install(ear=made)
    with pytest.raises(ConfigError, match=f"^plug-in ear .*theirs:ear.: {type(fault).__name__}: .+$"):
        open_source("ear")


def test_a_name_that_is_wrong_is_found_before_anything_is_loaded():
    code = (
        "import sys; from sfms_robot.sources.registry import check_source\n"
        "check_source('push', 'push')\n"
        "sys.exit(bool({'numpy', 'soundfile', 'soxr'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    for flag, choices in (
        ("audio", "mic, push, browser, ros2, FILE.wav"),
        ("face", "live-link, vmc, webcam, push"),
        ("agent_audio", "device, tcp, FILE.wav"),
    ):
        said = f"--{flag.replace('_', '-')} nothing-so: no such file .{choices}"
        with pytest.raises(ConfigError, match=said):
            check_source(**{flag: "nothing-so"})
    with pytest.raises(ConfigError, match="--audio -: sound is not read from a pipe: write it to a file .mic, push"):
        check_source("-")
