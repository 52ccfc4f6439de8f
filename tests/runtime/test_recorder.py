import base64
import json
import os
import threading
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FaceFrame, Plan, Reading, SpeakerFrame
from sfms_robot.ports import Tick
from sfms_robot.runtime import recorder as recorder_module
from sfms_robot.runtime.recorder import RUN_FILE, Recorder, check_folder, part_name, parts_of, write_report

JOINTS = ("neck_yaw", "jaw")


def tick(time_s, readings=None):
    return Tick(time_s, np.linspace(0, 1, 58, dtype=np.float32), np.array([0.25, -0.5]), readings or {})


def messages(folder):
    with (folder / RUN_FILE).open("rb") as file:
        return [
            (channel.topic, message.log_time, json.loads(message.data), schema)
            for schema, channel, message in make_reader(file).iter_messages()
        ]


def test_a_tick_becomes_a_face_and_joints_with_nulls_for_what_is_not_known(tmp_path):
    recorder = Recorder(tmp_path, JOINTS)
    recorder.tick(tick(1.5, {"neck_yaw": Reading(0.125, 0.01), "jaw": Reading(None, float("inf"), "silent")}))
    recorder.close()
    (face_topic, face_ns, face, _), (topic, _, body, schema), *_ = messages(tmp_path)
    assert (face_topic, topic, face_ns) == ("/face", "/joints", 1_500_000_000)
    assert list(face) == ["time_s", *CHANNELS] and face["tongueOut"] == 1.0
    assert body["joints"] == {
        "neck_yaw": {"goal_rad": 0.25, "present_rad": 0.125, "age_s": 0.01, "fault": None},
        "jaw": {"goal_rad": -0.5, "present_rad": None, "age_s": None, "fault": "silent"},
    }
    assert schema.encoding == "jsonschema" and set(json.loads(schema.data)["properties"]) == set(body)


def test_sound_and_plans_are_kept(tmp_path):
    audio = np.linspace(-1, 1, 640, dtype=np.float32)
    jaw_rad = np.array([[0.0, 0.25, 0.0], [0.0, 0.125, 0.0]], dtype=np.float32)
    face = replace(FaceFrame.of(0.04, np.full(58, 0.5)), jaw_rad=jaw_rad[0])
    recorder = Recorder(tmp_path, JOINTS)
    recorder.heard(SpeakerFrame(0.04, audio, face, -audio, attention=0.75, place_m=np.array([1.0, 0.5, 0.0])))
    recorder.heard(SpeakerFrame(0.08, np.zeros(0, dtype=np.float32)))
    recorder.planned(Plan(0.08, np.array([0.12, 0.16]), np.ones((2, 58), dtype=np.float32), jaw_rad))
    recorder.close()
    (_, _, first, _), (_, _, second, _), (topic, _, plan, _) = messages(tmp_path)
    pcm = np.frombuffer(base64.b64decode(first["audio_pcm16"]), dtype="<i2") / 32767
    np.testing.assert_allclose(pcm, audio, atol=2e-5)
    said = np.frombuffer(base64.b64decode(first["agent_audio_pcm16"]), dtype="<i2") / 32767
    np.testing.assert_allclose(said, -audio, atol=2e-5)
    assert second["agent_audio_pcm16"] is None and second["jaw_rad"] is None
    assert first["jaw_rad"] == [0.0, 0.25, 0.0] and plan["jaw_rad"] == jaw_rad.tolist()
    assert (first["attention"], first["place_m"]) == (0.75, [1.0, 0.5, 0.0]) and second["attention"] is None
    assert first["face"]["jawOpen"] == 0.5 and second["face"] is None and second["energy_db"] == -100
    assert topic == "/plan" and np.shape(plan["frames"]) == (2, 58) and plan["times_s"] == [0.12, 0.16]


class Gate:
    """Sound that cannot be encoded before the gate opens: the writer is busy for as long as a test needs."""

    def __init__(self):
        self.reached, self.opened = threading.Event(), threading.Event()

    def __array__(self, dtype=None, copy=None):
        self.reached.set()
        self.opened.wait(10)
        return np.zeros(1, dtype)

    def __len__(self):
        return 1


def stuck(recorder):
    gate = Gate()
    recorder.heard(SpeakerFrame(0.0, gate))
    assert gate.reached.wait(10)
    return gate


def test_a_full_queue_drops_and_counts_and_does_not_block(tmp_path):
    recorder = Recorder(tmp_path, JOINTS, queue_length=5)
    gate = stuck(recorder)
    for n in range(8):
        recorder.tick(tick(n / 100))
    gate.opened.set()
    recorder.close()
    told = recorder.statistics()
    assert told.pop("bytes") == sum(part.stat().st_size for part in parts_of(tmp_path)) > 0
    assert told == {"messages": 13, "dropped": 3, "trouble": None}


def test_states_are_kept_when_they_change_and_servos_once_a_second(tmp_path):
    recorder = Recorder(tmp_path, JOINTS, wait=True)
    for n, (state, why) in enumerate([("starting", ()), ("listening", ()), ("listening", ()), ("degraded", ("jaw",))]):
        warm = Reading(0.0, 0.0, extra={"temperature_C": 40.0 + n, "current_mA": float("nan")})
        recorder.tick(replace(tick(n * 0.5, {"jaw": warm}), state=state, why=why))
    recorder.close()
    found = messages(tmp_path)
    states = [(body["time_s"], body["state"], body["why"]) for topic, _, body, _ in found if topic == "/state"]
    assert states == [(0.0, "starting", []), (0.5, "listening", []), (1.5, "degraded", ["jaw"])]
    servos = [(body["time_s"], body["servos"]["jaw"]) for topic, _, body, _ in found if topic == "/servos"]
    assert servos == [
        (0.0, {"temperature_C": 40.0, "current_mA": None, "fault": None}),
        (1.0, {"temperature_C": 42.0, "current_mA": None, "fault": None}),
    ]


def test_close_is_idempotent_and_later_values_are_ignored(tmp_path):
    recorder = Recorder(tmp_path, JOINTS)
    recorder.close()
    recorder.tick(tick(0.0))
    recorder.close()
    assert messages(tmp_path) == []


def test_a_value_that_cannot_be_written_is_trouble_told_once_and_not_a_crash(tmp_path, caplog):
    recorder = Recorder(tmp_path, ("only_one",))
    recorder.tick(tick(0.0))
    recorder.tick(tick(0.1))
    recorder.close()
    assert "zip()" in recorder.statistics()["trouble"] and "the recording is incomplete" in caplog.text


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_is_named_with_its_flag_before_anything_moves_and_later_in_the_report(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "PART_MESSAGES", 10)
    named = f"--record {tmp_path}: No space left on device"
    (tmp_path / part_name(2)).symlink_to("/dev/full")
    recorder = Recorder(tmp_path, JOINTS, wait=True)
    for n in range(20):
        recorder.tick(tick(n / 100))
    recorder.close()
    assert recorder.statistics()["trouble"] == named
    (tmp_path / RUN_FILE).unlink()
    (tmp_path / RUN_FILE).symlink_to("/dev/full")
    with pytest.raises(ConfigError, match=f"^{named}$"):
        Recorder(tmp_path, JOINTS)


def test_a_folder_that_cannot_be_used_is_named_with_its_flag(tmp_path):
    with pytest.raises(ConfigError, match="^--record .*xxx: File name too long$"):
        check_folder(tmp_path / ("x" * 300))
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="--record .*file/run: Not a directory"):
        Recorder(tmp_path / "file" / "run", JOINTS)


def test_a_recording_is_not_overwritten_unasked(tmp_path):
    check_folder(tmp_path)
    Recorder(tmp_path, JOINTS).close()
    with pytest.raises(ConfigError, match="holds a recording already .*--overwrite"):
        check_folder(tmp_path)
    check_folder(tmp_path, overwrite=True)


def test_the_report_is_json_and_one_that_cannot_be_written_is_said(tmp_path, caplog):
    write_report(tmp_path / "new", {"version": 1})
    assert json.loads((tmp_path / "new" / "report.json").read_text()) == {"version": 1}
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["report.json"]
    (tmp_path / "file").write_text("")
    (tmp_path / "taken" / "report.json").mkdir(parents=True)
    for place in ("file", "taken"):
        write_report(tmp_path / place, {})
    assert caplog.text.count("the report cannot be written") == 2
    assert [path.name for path in (tmp_path / "taken").iterdir()] == ["report.json"]  # no part of one


def test_a_long_recording_goes_on_in_files_that_are_each_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "PART_MESSAGES", 10)
    recorder = Recorder(tmp_path, JOINTS, wait=True, queue_length=1)
    for k in range(13):
        recorder.tick(tick(k / 100))
    recorder.close()
    parts = parts_of(tmp_path)
    assert [part.name for part in parts] == ["run.mcap", "run-0002.mcap", "run-0003.mcap"]
    times = []
    for part in parts:
        with part.open("rb") as file:
            reader = make_reader(file)
            times += [message.log_time for _, channel, message in reader.iter_messages(topics=["/joints"])]
            assert reader.get_summary() is not None
    assert times == [round(k / 100 * 1e9) for k in range(13)] and recorder.statistics()["dropped"] == 0


def test_a_recording_that_is_replaced_leaves_no_part_of_the_old_one(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "PART_MESSAGES", 2)
    first = Recorder(tmp_path, JOINTS, wait=True)
    for k in range(5):
        first.tick(tick(k / 100))
    first.close()
    Recorder(tmp_path, JOINTS).close()
    assert [part.name for part in parts_of(tmp_path)] == ["run.mcap"]
