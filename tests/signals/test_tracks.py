import gzip
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, CHANNELS, ORDERS
from sfms_robot.signals.rotations import about
from sfms_robot.signals.tracks import Track, read_track, resample, write_track

JAW, SMILE, BLINK = CHANNEL_INDEX["jawOpen"], CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["eyeBlinkLeft"]
WEIGHTS = {name: round(0.01 + index / 60, 4) for index, name in enumerate(BLENDSHAPES)}


def table(header, *rows):
    return "\n".join(",".join(map(str, row)) for row in (header, *rows)) + "\n"


def written(path, header, *rows):
    path.write_text(table(header, *rows))
    return path


def upper_first(name):
    return name[0].upper() + name[1:]


@pytest.mark.parametrize("case", [str, upper_first, str.lower])
@pytest.mark.parametrize("order", ORDERS)
def test_every_column_order_and_case_reads_the_same(tmp_path, order, case):
    names = ORDERS[order]
    file = written(tmp_path / "a.csv", ["t_s", *map(case, names)], [0.0, *(WEIGHTS.get(name, 0.9) for name in names)])
    track = read_track(file)
    assert track.known == set(names) & set(BLENDSHAPES)
    expected = [WEIGHTS[name] if name in track.known else 0.0 for name in BLENDSHAPES]
    np.testing.assert_allclose(track.motion[0, 6:], expected, rtol=1e-6)


def test_live_link_timecode_counts_sixty_a_second_from_zero_and_runs_on_across_midnight(tmp_path):
    header = ["Timecode", "BlendShapeCount", "JawOpen", "HeadYaw", "HeadPitch", "HeadRoll"]
    codes = ["12:27:59:56.169", "12:27:59:58.169", "12:28:00:00.168", "12:28:00:02.168"]
    track = read_track(written(tmp_path / "a.csv", header, *([code, 61, 0.5, 0.3, 0.2, 0.1] for code in codes)))
    np.testing.assert_allclose(track.times_s, np.arange(4) / 30, atol=1e-4)
    np.testing.assert_allclose(track.motion[0, :3], [0.1, 0.2, 0.3], rtol=1e-6)  # radians: roll, pitch, yaw
    rows = [["23:59:59:58.0", 0.1], ["00:00:00:00.0", 0.2]]
    track = read_track(written(tmp_path / "a.csv", ["Timecode", "JawOpen"], *rows))
    np.testing.assert_allclose(track.times_s, [0, 1 / 30], atol=1e-9)


def test_pose_columns_carry_their_unit_in_the_name_and_a_cameras_distance_is_taken_off(tmp_path):
    degrees = written(tmp_path / "d.csv", ["t_s", "yaw_deg", "pitch_deg", "x_cm"], [0, 90, -45, 3])
    radians = written(tmp_path / "r.csv", ["t_s", "yaw_rad", "pitch", "x_mm"], [0, math.pi / 2, -math.pi / 4, 30])
    np.testing.assert_allclose(read_track(degrees).motion, read_track(radians).motion, atol=1e-6)
    assert read_track(degrees).motion[0, 3] == pytest.approx(0.03)
    header = ["t_s", "headYaw_deg", "headX_cm", "headY_cm", "headZ_cm"]
    track = read_track(written(tmp_path / "a.csv", header, *([t, 0, t, 10 * t, -40 + 2 * t] for t in range(3))))
    np.testing.assert_allclose(track.motion[2, 3:6], [0.02, 0.01, 0.1], atol=1e-6)


def test_a_row_with_empty_cells_or_that_counts_no_shapes_is_a_lost_face(tmp_path):
    file = written(tmp_path / "a.csv", ["t_s", "jawOpen", "eyeBlinkLeft"], [0, 0.1, 0.2], [0.1], [0.2, "", 0.1])
    assert np.isnan(read_track(file).motion).all(axis=1).tolist() == [False, True, True]
    file = written(tmp_path / "a.csv", ["t_s", "BlendshapeCount", "jawOpen"], [0, 61, 0.1], [0.1, 0], [0.2, 61, 0.1])
    assert np.isnan(read_track(file).motion).all(axis=1).tolist() == [False, True, False]


def test_gzip_is_known_by_its_content_and_a_tracker_that_overshoots_is_clipped(tmp_path):
    file = tmp_path / "track.csv"
    file.write_bytes(gzip.compress(b"\xef\xbb\xbft_s,jawOpen\n0,0.25\n"))
    assert read_track(file).motion[0, JAW] == 0.25
    track = read_track(written(tmp_path / "a.csv", FACE, [0, 1.2, -0.1]))
    assert track.motion[0].max() == 1.0 and track.motion[0].min() == 0.0


@pytest.mark.parametrize("name", ["track.csv", "track.csv.gz"])
def test_write_then_read_gives_the_track_back(tmp_path, name):
    motion = np.random.default_rng(1).uniform(0, 1, (5, 58)).astype(np.float32)
    motion[2] = np.nan
    track = Track(np.arange(5) / 25, motion, frozenset(CHANNELS))
    write_track(tmp_path / name, track)
    again = read_track(tmp_path / name)
    assert again.known == track.known
    np.testing.assert_allclose(again.motion, motion, atol=6e-5)
    np.testing.assert_allclose(again.times_s, track.times_s, atol=1e-4)


@given(st.floats(10, 120), st.floats(5, 60))
def test_resampling_a_straight_line_stays_on_it(from_hz, to_hz):
    times_s, motion = np.arange(30) / from_hz, np.zeros((30, 58), dtype=np.float32)
    motion[:, SMILE] = times_s / 10
    out = resample(Track(times_s, motion, frozenset(CHANNELS)), to_hz)
    np.testing.assert_allclose(out.motion[:, SMILE], out.times_s / 10, atol=1e-6)
    assert out.times_s[-1] <= times_s[-1] + 1e-6 < out.times_s[-1] + 1 / to_hz + 1e-5


def test_a_blink_of_one_row_survives_resampling_and_what_is_not_seen_stays_unknown():
    motion = np.zeros((60, 58), dtype=np.float32)
    motion[31, [BLINK, JAW]] = 1.0
    out = resample(Track(np.arange(60) / 60, motion, frozenset(CHANNELS)), 25)
    assert out.motion[:, BLINK].max() == 1.0 and out.motion[:, JAW].max() < 1.0
    motion = np.zeros((6, 58), dtype=np.float32)
    motion[1] = np.nan
    track = Track(np.array([0.1, 0.2, 0.3, 0.4, 0.9, 1.0]), motion, frozenset(CHANNELS))
    known = np.isfinite(resample(track, 10).motion[:, 0])
    assert known.tolist() == [False, True, False, True, True, False, False, False, False, True, True]


FACE = ["t_s", "jawOpen", "eyeBlinkLeft"]


NO_TRACK = [
    ("", "the file is empty"),
    ("t_s,jawOpen\n", "only a header"),
    ("t_s,jawOpne\n0,1\n", "no column is a face channel .*jawOpen"),
    ("jawOpen\n1\n", "no column tells the time .*Timecode"),
    ("frame,jawOpen\n0,0.1\n", "no column tells the time .*; frame counts: add a column time_s of frame / "),
    ("t_s,jawOpen\n0,0.5\n0.1,half\n", "row 3, column jawOpen = 'half' is not a number"),
    ("t_s,jawOpen\n0,inf\n", "row 2, column jawOpen = 'inf'"),
    ("t_s,jawOpen\n0.2,0.5\n0.1,0.5\n", "row 3, column t_s = '0.1' is not later"),
    ("Timecode,jawOpen\n12:00,0.5\n", "'12:00' is not HH:MM:SS:FF.fff"),
    ("t_s,jawOpen,JawOpen\n0,0.5,0.5\n", "column = 'JawOpen' gives jawOpen a second time"),
    ("t_s,yaw_cm\n0,0.5\n", "'yaw_cm' has a unit that does not fit"),
    (table(FACE, *([n, 35 * (n == 9), 0.2] for n in range(30))), "row 11, column jawOpen: expected 0 to 1 .*, got 35$"),
    (table(FACE, [0, 0.1, -4]), "row 2, column eyeBlinkLeft: expected 0 to 1 .*, got -4$"),
    (table(FACE, [0, 1e38, 0]), "row 2, column jawOpen: expected 0 to 1 .*, got 1e.38$"),
    (table(["t_s", "yaw"], *([n, 35 * (n == 9)] for n in range(30))), "row 11, column yaw: .* radians .*, got 35"),
    ("t_s,x\n0,600\n", "row 2, column x: expected metres .*, got 600; .* x_cm"),
    (table(FACE, [0, 0.1, 0.2], [0.04, 0.1], [0.08, 0.1, 0.2]), "row 3 has 2 cells, the header has 3"),
    (table(FACE, [0, 0.1, 0.2, 0.3]), "row 2 has 4 cells, the header has 3"),
    (table(["time_s", "jawOpen"], *([40 * n, 0.1] for n in range(5))), "time_s: .*40 s apart.* milliseconds"),
    (table(["t_ms", "jawOpen"], *([n / 25, 0.1] for n in range(5))), "t_ms: .*4e-05 s apart.* seconds"),
    (
        table(["Timecode", "JawOpen"], *([f"00:00:{n // 40:02d}:{n % 40:02d}.000", 0.5] for n in range(200))),
        "column Timecode: expected 24, 25, .* counts a second, got 40$",
    ),
    (bytes(range(256)), "cannot be read as a CSV"),
    (b"PK\x03\x04" + bytes(400), r"expected a face track, got an archive \(zip\): unpack it first"),
    (None, "no such file"),
]
NO_FRAMES = [(text, "expected a list of frames") for text in ("{}", "[1, 2]", '[{"a": "b"}]')]
NO_JSON = [(text, "cannot be read as JSON") for text in ("[", "[" * 100_000)]


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [("face.csv", *each) for each in NO_TRACK] + [("face.json", *each) for each in NO_FRAMES + NO_JSON],
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(tmp_path, name, content, told):
    file = tmp_path / name
    if content is not None:
        file.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ConfigError, match=told) as error:
        read_track(file)
    assert str(error.value).startswith(str(file)) and "\n" not in str(error.value)


@pytest.mark.parametrize("mark", [";", "\t"])
def test_cells_may_be_divided_by_semicolons_or_tabs_and_decimals_by_a_comma(tmp_path, mark):
    rows = (["t_s", "jawOpen", "yaw_deg"], ["0", "0,25", "-9,0"], ["0,04", "0.5", ""])
    (tmp_path / "a.csv").write_text("\r\n".join(mark.join(row) for row in rows))
    track = read_track(tmp_path / "a.csv")
    assert track.times_s.tolist() == [0.0, 0.04] and track.motion[0, JAW] == 0.25
    assert track.motion[0, CHANNEL_INDEX["yaw"]] == pytest.approx(math.radians(-9)) and np.isnan(track.motion[1]).all()


def test_a_last_row_that_is_cut_off_and_a_doubled_row_are_left_out_and_said(tmp_path, caplog):
    track = read_track(written(tmp_path / "a.csv", FACE, [0, 0.1, 0.2], [0.04, 0.3, 0.2], [0.08, 0.3]))
    assert len(track.times_s) == 2 and "last row is cut off" in caplog.text
    rows = [[n / 25, 0.1, 0.2] for n in (0, 1, 1, 2)]
    assert len(read_track(written(tmp_path / "a.csv", FACE, *rows)).times_s) == 3
    assert "rows with the time of the row before are left out: 1" in caplog.text
    with pytest.raises(ConfigError, match="column t_s: 18 of 20 rows have the time of the row before"):
        read_track(written(tmp_path / "b.csv", FACE, *([n // 10, 0.1, 0.2] for n in range(20))))


LIVE_LINK = ["Timecode", "BlendShapeCount", "JawOpen", "HeadYaw", "HeadPitch", "HeadRoll", "LeftEyeYaw"]


def warnings(caplog, path):
    return [record.getMessage().removeprefix(f"{path}: ") for record in caplog.records]


def test_other_spellings_are_read_and_what_is_left_out_is_counted_and_named(tmp_path, caplog):
    header = ["time_s", "frame", "eyeBlink_L", "BlendShape.eyeBlink_R", "mouth_smile_left", "jawOpne", "mood"]
    file = written(tmp_path / "a.csv", header, *([n / 25, n, 0.9, 0.8, 0.7, 0.5, 1] for n in range(5)))
    track = read_track(file)
    assert track.known == {"eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft"}
    np.testing.assert_allclose(track.motion[0, [BLINK, BLINK + 1, SMILE]], [0.9, 0.8, 0.7])
    assert warnings(caplog, file) == ["3 of 52 channels used; not known: jawOpne, mood"]


def test_all_that_the_live_link_app_writes_is_known_and_percent_is_read_as_percent(tmp_path, caplog):
    read_track(written(tmp_path / "a.csv", LIVE_LINK, ["10:00:00:00.000", 61, 0.2, 0.1, 0.1, 0.1, 0.1]))
    assert not caplog.records
    track = read_track(written(tmp_path / "a.csv", FACE, *([n / 25, 40, 0.5] for n in range(5))))
    assert track.motion[0, JAW] == pytest.approx(0.4) and track.motion[0, BLINK] == pytest.approx(0.005)
    assert "blendshapes are taken as percent" in caplog.text


def test_a_head_in_small_degrees_is_read_as_degrees_and_declared_units_are_believed(tmp_path, caplog):
    yaw = [5.5 * math.sin(n / 3) for n in range(25)]
    rows = [[f"10:00:00:{2 * n:02d}.000", 61, 0.2, each, 4.0, 0, 0] for n, each in enumerate(yaw)]
    file = written(tmp_path / "a.csv", LIVE_LINK, *rows)
    np.testing.assert_allclose(read_track(file).motion[:, 2], np.radians(yaw), atol=1e-6)
    assert len(caplog.records) == 1 and "angles are taken as degrees" in caplog.text
    header = ["t_s", "yaw", "pitch_rad", "roll_deg"]
    motion = read_track(written(tmp_path / "a.csv", header, *([n / 25, 20, 0.3, 3] for n in range(9)))).motion
    np.testing.assert_allclose(motion[:, :3], np.tile([math.radians(3), 0.3, math.radians(20)], (9, 1)), rtol=1e-6)


@pytest.mark.parametrize("counts", [24, 25, 30, 48, 50, 60, 100])
def test_a_timecode_of_any_count_is_even_and_of_the_right_rate(tmp_path, counts):
    rows = [[f"00:00:{n // counts:02d}:{n % counts:02d}.{n % 1000:03d}", 0.5] for n in range(130, 2 * counts + 140)]
    times_s = read_track(written(tmp_path / "a.csv", ["Timecode", "JawOpen"], *rows)).times_s
    np.testing.assert_allclose(np.diff(times_s), 1 / counts, rtol=0.01)


@pytest.mark.parametrize("counts", [30, 60])
def test_drop_frame_timecode_runs_on_over_a_minute_at_29_97(tmp_path, counts):
    labels = [(59, n) for n in range(counts)] + [(60, n) for n in range(counts // 15, counts)]
    rows = [[f"00:{second // 60:02d}:{second % 60:02d};{n:02d}", 0.5] for second, n in labels]
    times_s = read_track(written(tmp_path / "a.csv", ["Timecode", "JawOpen"], *rows)).times_s
    np.testing.assert_allclose(np.diff(times_s), 1.001 / counts, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "step", "unit"),
    [("timestamp", 0.04, ""), ("timestamp", 40, "ms"), ("time", 40_000, "us"), ("t_ms", 40, "")],
)
def test_a_time_is_in_the_unit_that_makes_frames_of_it(tmp_path, caplog, name, step, unit):
    file = written(tmp_path / "a.csv", [name, "jawOpen"], *([n * step, 0.1] for n in range(5)))
    np.testing.assert_allclose(read_track(file).times_s, np.arange(5) / 25)
    assert warnings(caplog, file) == ([f"column {name} is taken as {unit}: call it {name}_{unit}"] if unit else [])


MEDIAPIPE = (
    '{"timestamp": 0, "faceBlendshapes": [{"categories": [{"index": 25, "score": 0.2, "categoryName": "jawOpen"},'
    ' {"index": 44, "score": 0.6, "categoryName": "mouthSmileLeft"}]}]}'
)


@pytest.mark.parametrize(
    "text",
    [
        f'[{MEDIAPIPE}, {{"timestamp": 40, "faceBlendshapes": []}}]',
        f'{{"fps": 25, "frames": [{MEDIAPIPE}, {{"timestamp": 40}}]}}',
        '[{"time_s": 0, "blendshapes": {"jawOpen": 0.2, "mouthSmile_L": 0.6}}, {"time_s": 0.04, "blendshapes": null}]',
        '[{"time_s": 0, "JawOpen": 0.2, "mouthSmileLeft": 0.6}, {"time_s": 0.04}]',
    ],
)
def test_json_is_read_as_a_table(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    track = read_track(tmp_path / "a.json")
    np.testing.assert_allclose(track.motion[0, [JAW, SMILE]], [0.2, 0.6], rtol=1e-6)
    assert np.isnan(track.motion[1]).all() and track.times_s.tolist() == [0.0, 0.04]


TURNED = about(1, 0.3) @ about(0, 0.2) @ about(2, -0.1)  # a camera's axes: yaw about y, pitch about x, roll about z
MATRIX = np.block([[TURNED, np.array([[3.0], [-5.0], [-40.0]])], [np.array([0.0, 0.0, 0.0, 1.0])]])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("facialTransformationMatrixes", [{"rows": 4, "columns": 4, "data": MATRIX.T.ravel().tolist()}]),  # in browsers
        ("facial_transformation_matrixes", [MATRIX.tolist()]),  # in Python
        ("transformation_matrix", MATRIX.ravel().tolist()),
    ],
)
def test_the_transformation_matrix_of_mediapipe_is_the_head_pose(tmp_path, key, value):
    shapes = {"faceBlendshapes": [{"categories": [{"categoryName": "jawOpen", "score": 0.2}]}]}
    points = {"faceLandmarks": [[{"x": 0.5, "y": 0.4, "z": 0.01}]]}
    frames = [{"time_s": n / 25, key: value, **shapes, **points} for n in range(3)] + [{"time_s": 0.12, key: []}]
    (tmp_path / "a.json").write_text(json.dumps(frames))
    track = read_track(tmp_path / "a.json")
    np.testing.assert_allclose(track.motion[0, :6], [-0.1, 0.2, 0.3, 0.0, 0.0, 0.0], atol=1e-6)  # it stands still
    assert track.motion[0, JAW] == pytest.approx(0.2) and np.isnan(track.motion[3]).all()


def test_a_matrix_that_is_none_is_named_and_the_face_is_used(tmp_path, caplog):
    frames = [{"time_s": n / 25, "jawOpen": 0.2, "transformMatrix": [1, 2, 3]} for n in range(3)]
    (tmp_path / "a.json").write_text(json.dumps(frames))
    assert read_track(tmp_path / "a.json").motion[2, JAW] == pytest.approx(0.2)
    assert "not known: transformMatrix" in caplog.text


def test_openface_turns_and_its_action_units_are_read(tmp_path, caplog):
    header = "frame, timestamp, confidence, success, pose_Tz, pose_Rx, pose_Ry, pose_Rz, AU12_r, AU23_r, AU45_r, AU12_c"
    rows = [[n, n / 25, 0.98, n != 2, 600, 0.1, 0.0, 0.0, 2.0, 0, 5.0, 1] for n in range(4)]
    rows[3][5:8] = [0.0, 0.2, 0.3]
    rows = [[int(each) if isinstance(each, bool) else each for each in row] for row in rows]
    track = read_track(written(tmp_path / "a.csv", header.split(","), *rows))
    np.testing.assert_allclose(track.motion[0, :3], [0.0, 0.1, 0.0], atol=1e-6)  # nose down
    np.testing.assert_allclose(track.motion[3, :3], [-0.3, 0.0, -0.2], atol=1e-6)  # to the own right, left ear down
    np.testing.assert_allclose(track.motion[0, [SMILE, BLINK]], [0.4, 1.0])
    assert np.isnan(track.motion[2]).all() and "not known: AU23_r" in caplog.text
