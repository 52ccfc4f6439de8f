"""A recording read back: what was recorded, whatever is missing at its end."""

import json
import tracemalloc

import numpy as np
import pytest
from recorded_runs import JOINTS, record

from sfms_robot.app.replay.run_file import read_recording, summary
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, FRAME_S, Plan, SpeakerFrame
from sfms_robot.ports import Tick
from sfms_robot.runtime import recorder as recorder_module
from sfms_robot.runtime.recorder import RUN_FILE, Recorder


def test_what_was_recorded_is_read_back(tmp_path):
    run = read_recording(record(tmp_path))
    assert run.joints == JOINTS and run.about["head"] == "face28" and run.whole
    np.testing.assert_allclose(run.times_s, np.arange(200) / 100, atol=1e-9)
    np.testing.assert_allclose(run.goals_rad[:, 1], run.times_s / 10, atol=1e-5)
    np.testing.assert_allclose(run.present_rad[:, 0], run.goals_rad[:, 0], atol=1e-5)
    assert np.isnan(run.present_rad[:, 1:]).all() and run.faults.any(axis=0).tolist() == [False, True, False]
    assert run.motion.shape == (200, 58) and len(run.audio) == 50 * 640
    assert np.isnan(run.speaker[1::2]).all() and (run.speaker[::2] == 0.25).all()
    assert run.states == [(0.0, "listening", ()), (1.5, "halted", ("key",))]
    assert run.hottest_C == 41.0


def test_the_heads_own_voice_is_read_back_beside_the_persons(tmp_path):
    recorder = Recorder(tmp_path, JOINTS, wait=True)
    recorder.tick(Tick(0.0, np.zeros(58, np.float32), np.zeros(3), {}))
    for index in range(3):
        said = np.full(640, 0.25 * (index + 1), np.float32)  # of the frame that comes next, as sources give it
        recorder.heard(SpeakerFrame((index + 1) * FRAME_S, np.zeros(640, np.float32), None, said))
    recorder.close()
    run = read_recording(tmp_path)
    np.testing.assert_allclose(run.agent_audio[::640], [0.0, 0.25, 0.5], atol=2e-5)


def test_events_that_plans_held_are_read_back(tmp_path):
    recorder = Recorder(tmp_path, JOINTS, wait=True)
    recorder.tick(Tick(0.0, np.zeros(58, np.float32), np.zeros(3), {}))
    times_s, frames = np.arange(1, 51) * FRAME_S, np.zeros((50, 58), np.float32)
    frames[20:23, [CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"]]] = 1.0
    recorder.planned(Plan(0.0, times_s, frames))
    recorder.close()
    ((start_s, kind),) = read_recording(tmp_path).events
    assert kind == "blink" and start_s == pytest.approx(times_s[20], abs=2 * FRAME_S)


def test_reading_holds_numbers_and_no_messages(tmp_path):
    """Nothing is kept on the way that is much larger than the arrays."""
    record(tmp_path, 20.0)
    tracemalloc.start()
    run, peak = read_recording(tmp_path), tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    kept = sum(value.nbytes for value in vars(run).values() if isinstance(value, np.ndarray))
    assert peak < 6 * kept, f"{peak / 2000:.0f} bytes a tick"


def test_phrases_are_where_the_speaker_talks(tmp_path):
    run = read_recording(record(tmp_path))
    assert run.talks_at(np.array([0.02, 0.5, 0.98, 1.06, 1.9])).tolist() == [True, True, True, False, False]
    silent = read_recording(record(tmp_path / "silent", voice=False))
    assert not silent.has_voice and not silent.talking.any()


def test_a_summary_counts(tmp_path):
    counted = summary(read_recording(record(tmp_path)))
    assert counted.pop("started_utc").startswith("20")
    assert counted == {
        "head": "face28", "seed": 3, "duration_s": 1.99, "ticks": 200, "speaker_frames": 50, "plans": 50,
        "events": {}, "states": ["listening", "halted"], "hottest_C": 41.0, "joints": 3, "faults": 1, "whole": True,
    }  # fmt: skip


def test_a_file_without_its_end_is_read_up_to_there(tmp_path):
    file = record(tmp_path, seconds=20.0) / RUN_FILE
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    run = read_recording(tmp_path)
    assert not run.whole and 3.0 < run.duration_s < 19.0 and "cut off" in run.title
    assert len(run.motion) == len(run.goals_rad) == len(run.times_s)


def test_what_cannot_be_read_is_said_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match="has no run.mcap"):
        read_recording(tmp_path)
    with pytest.raises(ConfigError, match="is no folder"):
        read_recording(tmp_path / "nothing")
    file = record(tmp_path / "run") / RUN_FILE
    data = bytearray(file.read_bytes())
    for broken, message in (
        (b"", "cut off"),
        (bytes(data[:300]), "holds no tick: the file is cut off"),
        (b"not an mcap file at all", "not a recorded run"),
        (bytes(data[:4000]) + bytes([data[4000] ^ 0x55]) + bytes(data[4001:]), "damaged"),
    ):
        file.write_bytes(broken)
        with pytest.raises(ConfigError, match=message) as error:
            read_recording(tmp_path / "run")
        assert "\n" not in str(error.value)
    Recorder(tmp_path / "short", JOINTS).close()
    with pytest.raises(ConfigError, match="the run never began"):
        read_recording(tmp_path / "short")


def test_a_recording_in_several_files_is_read_as_one(tmp_path, monkeypatch):
    one = read_recording(record(tmp_path / "one"))
    monkeypatch.setattr(recorder_module, "PART_MESSAGES", 100)
    many = read_recording(record(tmp_path / "many"))
    assert len(recorder_module.parts_of(tmp_path / "many")) > 3
    assert many.whole and np.array_equal(one.times_s, many.times_s)
    assert np.array_equal(one.goals_rad, many.goals_rad) and np.array_equal(one.audio, many.audio)


def same(one, other):
    """Return whether two values are equal, NaN beside NaN."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return np.array_equal(one, other, equal_nan=True) if isinstance(one, np.ndarray) else one == other


def test_a_recording_in_the_messages_of_ros_2_is_read_as_one_in_json(tmp_path):
    one, other = (read_recording(record(tmp_path / kind, record_format=kind)) for kind in ("json", "ros2"))
    for name, value in vars(one).items():
        assert name == "about" or same(value, getattr(other, name)), name  # `about` has the time of day
    assert one.about.keys() == other.about.keys()


def test_rosbags_opens_a_recording_in_the_messages_of_ros_2_without_definitions_of_its_own(tmp_path):
    highlevel = pytest.importorskip("rosbags.highlevel", reason="needs rosbags, of the extra [dev]")
    file = record(tmp_path, record_format="ros2") / RUN_FILE
    with highlevel.AnyReader([file]) as bag:
        read = {}
        for connection, at_ns, data in bag.messages():
            read.setdefault(connection.topic, []).append((at_ns, bag.deserialize(data, connection.msgtype)))
        kinds = {each.topic: each.msgtype for each in bag.connections}
    assert kinds["/joint_states"] == "sensor_msgs/msg/JointState" and len(read["/joint_states"]) == 200
    at_ns, joints = read["/joint_states"][50]
    assert at_ns == 500_000_000 and (joints.header.stamp.sec, joints.header.stamp.nanosec) == (0, 500_000_000)
    assert tuple(joints.name) == JOINTS
    np.testing.assert_allclose(joints.position, [0.2 * np.sin(0.5), 0.05, 0.0], atol=1e-5)
    assert len(read["/audio"]) == 50 and len(read["/audio"][0][1].audio.data) == 1280
    assert len(read["/robot_face/action_units"][0][1].intensity) == 99
    assert [each.status[0].message for _, each in read["/diagnostics"]] == ["listening", "halted"]
    assert read["/diagnostics"][1][1].status[0].values[0].value == "key"
    assert json.loads(read["/sfms_robot/face"][0][1].data).keys() == {"time_s", *CHANNELS}
