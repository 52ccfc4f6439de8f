"""`run --agent-audio` from end to end in virtual time: the robot's own voice, ARIG, emulated servos."""

import dataclasses
import json
from contextlib import closing

import numpy as np
import pytest
import soundfile
import torch

from sfms_robot import config
from sfms_robot.app.options import RunOptions
from sfms_robot.app.replay.play_back import pictures, play_back
from sfms_robot.app.replay.run_file import _records, read_recording
from sfms_robot.app.session import run
from sfms_robot.config.listener import STATES, paper_state
from sfms_robot.data import data_dir
from sfms_robot.frames import CHANNEL_INDEX
from sfms_robot.lab.evaluation.rollout import speaker_frames
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.registry import load_listener
from sfms_robot.runtime.recorder import RUN_FILE
from sfms_robot.sources.registry import open_source
from sfms_robot.viewer.page_messages import frame_json

SHIPPED = data_dir("configs") / "listeners" / "arig-small"
RAW = {"kind": "arig", "width": 16, "feedforward": 24, "heads": 2, "context_chunks": 4, "context_layers": 1}
JAW = CHANNEL_INDEX["jawOpen"]
trained = pytest.mark.skipif(not (SHIPPED / checkpoint.WEIGHTS).is_file(), reason="arig-small has no weights here")


@pytest.fixture(scope="module")
def seeded(tmp_path_factory):
    """A small ARIG with seeded weights: it moves for nothing in particular."""
    folder = tmp_path_factory.mktemp("arig")
    settings = config.parse(config.Arig, RAW | {"diffusion": {"width": 10, "steps": 4, "train_steps": 50}}, "tiny")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = ArigModel(settings)
    model.motion_std.fill_(0.02)
    model.motion_mean[6:] = 0.2
    checkpoint.save_config(folder, settings)
    checkpoint.save_weights(folder / checkpoint.WEIGHTS, model)
    return folder


def voice(file, seconds: float):
    """A shipped voice, cut off after so many seconds."""
    samples, rate = soundfile.read(data_dir("sim") / "speakers" / "katie" / "speech.flac")
    assert len(samples) >= seconds * rate
    soundfile.write(file, samples[: int(seconds * rate)], rate)
    return str(file)


def listened(listener, **options):
    return run(dataclasses.replace(RunOptions(listener=str(listener), fast=True, seed=3), **options))


@pytest.mark.slow
def test_a_voice_shorter_than_the_run_ends_and_the_head_goes_on(seeded, tmp_path):
    said = voice(tmp_path / "said.wav", 0.6)
    done = listened(seeded, agent_audio=said, duration_s=2.0)
    assert (done["exit"], done["frames"], done["limits"]["violations"]) == ("done", 50, 0)
    mute = listened(seeded, duration_s=2.0)
    assert done["wire"]["main"]["sha256"] != mute["wire"]["main"]["sha256"]
    assert done == listened(seeded, agent_audio=said, duration_s=2.0)
    alone = listened(seeded, audio="none", face="none", agent_audio=said)  # with no person at all
    assert (alone["exit"], alone["frames"], alone["limits"]["violations"]) == ("done", 15, 0)


@pytest.mark.slow
@trained
def test_the_jaw_moves_with_the_robots_own_voice_and_rests_when_it_stops(tmp_path):
    listened(SHIPPED, agent_audio=voice(tmp_path / "said.wav", 4.0), duration_s=9.0, record=tmp_path / "run")
    shown = read_recording(tmp_path / "run")
    jaw, at_s = shown.motion[:, JAW], shown.times_s
    talking, after = jaw[(at_s > 0.5) & (at_s < 4.0)], jaw[at_s > 5.5]
    assert np.std(talking) > 2 * np.std(after) and np.mean(talking) > 2 * np.mean(after)


@pytest.mark.slow
def test_a_recording_of_a_head_that_speaks_moves_a_head_and_a_listener_as_the_run_did(seeded, tmp_path):
    said = voice(tmp_path / "said.wav", 2.0)
    done = listened(seeded, agent_audio=said, duration_s=3.0, record=tmp_path / "run")
    played = play_back(tmp_path / "run", fast=True)
    assert played["motion"] == done["motion"]
    for end in ("min_rad", "max_rad"):
        assert played["joints"]["jaw"][end] == pytest.approx(done["joints"]["jaw"][end], abs=0.02)

    recording = read_recording(tmp_path / "run")
    assert recording.agent_audio.shape == recording.audio.shape
    with closing(open_source(duration_s=3.0, agent_audio=said)) as source:
        given = source.read(3.0)
    heard = speaker_frames(recording.audio, recording.speaker, recording.agent_audio)
    for one, other in zip(heard[:-1], given[:-1], strict=True):  # what is said after the last frame is not in its file
        np.testing.assert_allclose(one.agent_audio, other.agent_audio, atol=2e-5)
    planned = np.array([body["frames"][0] for kind, body in _records(tmp_path / "run" / RUN_FILE) if kind == "/plan"])
    mute = speaker_frames(recording.audio, recording.speaker, None)
    away = [np.abs(answers(seeded, frames[: len(planned)]) - planned).max() for frames in (heard, mute)]
    assert away[0] < 1e-3 < 0.02 < away[1]
    own_db = [json.loads(frame_json(record))["own"] for record in pictures(recording)]
    assert max(own_db[5:45]) > -40 and own_db[-1] == -100


def answers(folder, frames):
    """What a listener of seed 3 plans for the next frame (N, 58), one frame after the other."""
    listener = load_listener(folder)
    memory, planned = listener.start(3), []
    for frame in frames:
        plan, memory = listener.step(frame, memory)
        planned.append(plan.frames[0])
    return np.array(planned)


@trained
def test_a_robot_that_stops_speaking_while_somebody_talks_listens_within_a_second(tmp_path):
    listener = load_listener(SHIPPED)
    memory, states = listener.start(3), []
    for frame in open_source(duration_s=6.0, agent_audio=voice(tmp_path / "said.wav", 4.0)).read(6.0):
        _, memory = listener.step(frame, memory)
        states.append(STATES[paper_state(memory.how.state)])
    assert "listening" not in states[75:99] and set(states[75:99]) <= {"speaking", "interrupted", "giving_feedback"}
    assert set(states[125:]) <= {"listening", "giving_feedback"}
