"""`--face webcam`: a face in our axes, the choice among several, and pictures of a camera, or none."""

import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripted_worker import shows

from sfms_robot.errors import ConfigError, MissingExtra, PortError
from sfms_robot.face.drawing import VirtualWebcam
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, ORDERS
from sfms_robot.lab.bench.webcam_bench import face_of, webcam, write_video
from sfms_robot.signals.rotations import rotation
from sfms_robot.sources import webcam as camera_source
from sfms_robot.sources.worker import SourceWorker

pytestmark = pytest.mark.realtime

ORIGIN_S = 1000.0
PLACE_M = np.array([0.6, 0.0, 0.0], np.float32)
FACE = camera_source.SeenFace(face_of(pitch=0.1), PLACE_M)


def seen(time_s, face=FACE, others=0, dark=False):
    """A picture of loop time `time_s`, known 20 ms later."""
    taken_s = ORIGIN_S + time_s
    return camera_source.SeenPicture(taken_s=taken_s, known_s=taken_s + 0.02, face=face, others=others, dark=dark)


@pytest.fixture
def camera():
    """A webcam that has sent these messages."""
    opened = []

    def of(*messages):
        worker = SourceWorker("webcam 0", shows, messages)
        opened.append(worker)
        for _ in messages:
            worker.wait()
        return camera_source.Webcam(worker, np.ones(6, np.float32), None)

    yield of
    for worker in opened:
        worker.close()


def test_the_newest_face_since_the_start_at_or_before_is_seen_however_old(camera):
    looking = camera(seen(-0.5), seen(0.02), seen(0.05), seen(0.09))
    assert looking.at(0.0) is None and looking.latency_s == 0.0
    looking.start(ORIGIN_S)
    assert looking.at(0.01) is None and looking.at(0.04).face.time_s == pytest.approx(0.02)
    assert looking.at(0.1).face.time_s == pytest.approx(0.09) and looking.at(5.0).face.time_s == pytest.approx(0.09)
    np.testing.assert_array_equal(looking.at(5.0).place_m, PLACE_M)
    assert looking.at(5.0).attention is None
    assert looking.latency_s == pytest.approx(0.02) and looking.statistics()["pictures"] == 3


def test_what_was_not_seen_is_counted(camera):
    looking = camera(seen(0.1), seen(0.2, None), seen(0.3, None, dark=True), seen(0.4, others=2))
    looking.start(ORIGIN_S)
    looking.at(0.35)
    told = looking.statistics()
    assert {key: told[key] for key in ("pictures", "without_face", "dark", "with_others")} == {
        "pictures": 4, "without_face": 2, "dark": 1, "with_others": 1,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("argument", "error", "text"),
    [
        ("nobody.avi", ConfigError, r"--face webcam:nobody\.avi: no such file, nor the number of a camera"),
        (__file__, ConfigError, "not a video that can be played"),
        ("97", PortError, r"--face webcam: no camera 97 \((there are|none is plugged in)"),
    ],
)
def test_what_cannot_be_opened_is_one_line(argument, error, text):
    with pytest.raises(error, match=text) as raised:
        camera_source.open_webcam(argument)
    assert "\n" not in str(raised.value)


def test_without_the_extra_the_install_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(MissingExtra, match=r"--face webcam needs .*pip install -e '.*\[webcam\]'"):
        next(camera_source.watch("0"))


@pytest.fixture
def grey_video(tmp_path):
    file = tmp_path / "grey.avi"
    write_video(file, [np.full((48, 64, 3), 40 * k, np.uint8) for k in range(5)], 10)
    return str(file)


def test_a_camera_that_gives_no_more_pictures_went_away_and_a_video_waits_for_its_time(grey_video):
    pictures = camera_source.live(camera_source.open_video(grey_video), "3")
    means = [next(pictures)[1].mean() for _ in range(5)]
    assert means == sorted(means)
    with pytest.raises(PortError, match="camera 3 went away"):
        next(pictures)
    due_s, nothing_yet = next(camera_source.played(camera_source.open_video(grey_video), time.monotonic() + 60.0))
    assert nothing_yet is None and due_s > time.monotonic()
    assert list(camera_source.played(camera_source.open_video(grey_video), time.monotonic() - 60.0)) == []


def test_a_worker_says_what_it_opened_and_waits_to_be_told_when_to_begin(grey_video):
    work = camera_source.watch(grey_video)
    assert next(work) == camera_source.WebcamOpened(0.5) and work.send(None) is None
    first = work.send(time.monotonic())
    while first is None:
        first = work.send(None)
    work.close()
    assert first.face is None and first.dark and first.others == 0


def test_a_covered_lens_shows_no_face():
    landmarker = camera_source.Landmarker()
    assert landmarker.faces(np.zeros((480, 640, 3), np.uint8), 0.0) == []
    landmarker.close()


def matrix_of(roll, pitch, yaw, right_up_near_cm=(0.0, 0.0, -60.0)):
    """Face -> camera as MediaPipe gives it: our rotation, with x = left, y = up, z = forward."""
    theirs, matrix = [1, 2, 0], np.eye(4)  # their axes, among ours
    matrix[:3, :3] = rotation(np.array([roll, pitch, yaw]))[np.ix_(theirs, theirs)]
    matrix[:3, 3] = right_up_near_cm
    return matrix


@given(st.tuples(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(-3.0, 3.0)))
def test_the_rotation_is_ours_signs_included(turn):
    pose = camera_source.seen_face(matrix_of(*turn), {}).motion[:3]
    np.testing.assert_allclose(matrix_of(*pose), matrix_of(*turn), atol=1e-5)


@pytest.mark.parametrize(
    ("yaw", "right_up_near_cm", "place", "eyes"),
    [
        (0, (10.0, 5.0, -60.0), (-0.6, 0.1, 0.05), (0.6 - 0.0347, -0.1, 0.05 + 0.0262)),
        (np.pi / 2, (0.0, 0.0, -60.0), (-0.6, 0.0, 0.0), (0.6, -0.0347, 0.0262)),  # to their left: the picture's right
    ],
)
def test_the_place_is_the_persons_and_the_eyes_are_seen_from_the_camera(yaw, right_up_near_cm, place, eyes):
    seen = camera_source.seen_face(matrix_of(0, 0, yaw, right_up_near_cm), {})
    np.testing.assert_allclose(seen.motion[3:6], place, atol=1e-6)
    np.testing.assert_allclose(seen.place_m, eyes, atol=1e-6)


def test_blendshapes_go_by_name_and_the_tongue_is_not_seen():
    told = {name: place / 100 for place, name in enumerate(ORDERS["mediapipe"])}
    seen = camera_source.seen_face(matrix_of(0, 0, 0), told)
    for name in BLENDSHAPES:
        assert seen.motion[CHANNEL_INDEX[name]] == np.float32(told.get(name, 0.0))
    assert seen.motion[CHANNEL_INDEX["tongueOut"]] == 0.0


STEP_S = 1 / 30
LEFT, RIGHT = np.array([0.6, 0.3, 0.0]), np.array([0.6, -0.3, 0.0])


def followed(pictures):
    """The chosen place in every picture (a list of places), None where nobody is."""
    before, out = None, []
    for number, places in enumerate(pictures):
        index, before = camera_source.choose(places, number * STEP_S, before)
        out.append(None if index is None else places[index])
    return out


@given(st.lists(st.tuples(st.floats(0.93, 1.07), st.floats(0.93, 1.07), st.booleans()), min_size=1, max_size=120))
def test_of_two_that_are_equally_near_the_first_chosen_stays(sways):
    pictures = []
    for left, right, swapped in [(1.0, 1.01, False), *sways]:
        both = [left * LEFT, right * RIGHT]
        pictures.append(both[::-1] if swapped else both)
    assert all(place[1] > 0 for place in followed(pictures))


def test_a_person_is_left_only_for_one_clearly_nearer_or_once_gone_and_followed_as_it_walks():
    near = 0.9 * camera_source.NEARER * RIGHT
    chosen = followed([[LEFT]] * 10 + [[LEFT, near]] * 90)
    switches = [k for k in range(1, len(chosen)) if chosen[k] is not chosen[k - 1]]
    assert len(switches) == 1 and (switches[0] - 10) * STEP_S == pytest.approx(
        camera_source.TAKE_OVER_S, abs=2 * STEP_S
    )
    chosen = followed([[LEFT]] + [[RIGHT]] * 60)
    alone = [place is None for place in chosen[1:]]
    taken = alone.index(False)
    assert taken * STEP_S == pytest.approx(camera_source.GONE_S, abs=2 * STEP_S) and not any(alone[taken:])
    walk = [[np.array([0.6, y, 0.0]), np.array([0.9, 0.0, 0.1])] for y in np.linspace(-0.4, 0.4, 60)]
    assert all(place[0] == 0.6 for place in followed(walk))


LEANS_IN = [[LEFT, 0.9 * camera_source.NEARER * RIGHT]] * round(0.8 * camera_source.TAKE_OVER_S / STEP_S)
HIDDEN = [[RIGHT]] * round(0.8 * camera_source.GONE_S / STEP_S)  # the chosen one


@pytest.mark.parametrize("moment", [(LEANS_IN + [[LEFT, RIGHT]]) * 5, HIDDEN + [[RIGHT, LEFT]] * 5])
def test_a_moment_changes_nothing(moment):
    assert all(place is LEFT or place is None for place in followed([[LEFT, RIGHT]] + moment))


@given(st.permutations(range(3)))
def test_the_order_of_the_faces_does_not_matter(order):
    faces = [LEFT, 0.7 * RIGHT, 1.5 * LEFT]
    assert followed([[faces[k] for k in order]])[0] is faces[1]


@pytest.mark.slow
def test_channels_come_back_with_their_signs_and_on_their_side():
    turns, moves = ("roll", "pitch", "yaw"), ("x", "y", "z")
    pairs = (("eyeBlinkLeft", "eyeBlinkRight"), ("mouthSmileLeft", "mouthSmileRight"))
    others = ("eyeLookOutLeft", "eyeLookInLeft", "mouthRight", "jawOpen")  # mouthLeft is seen on some processors only
    result = webcam((*turns, *moves, *sum(pairs, ()), *others))
    assert [name for name, row in result["channels"].items() if not row["seen"]] == []
    for name in turns:
        assert 0.6 < result["channels"][name]["slope"] < 1.4
    for axis in moves:
        assert result["place"][axis]["slope"] > 0.5 and result["place"][axis]["correlation"] > 0.95
    for left, right in pairs:
        for name, other in ((left, right), (right, left)):
            row = result["channels"][name]
            assert row["with"] != other or row["with_change"] < 0.7 * row["slope"]
    assert all(ms["p50"] > 0 for ms in result["timings_ms"].values())


@pytest.mark.slow
def test_a_recorded_video_is_played_from_the_start_on_in_its_own_process(tmp_path):
    camera = VirtualWebcam()
    still, nodding = camera.picture(face_of()), camera.picture(face_of(pitch=0.25, jawOpen=0.8))
    file = tmp_path / "nod.avi"
    write_video(file, [still] * 20 + [nodding] * 20, 20)
    webcam = camera_source.open_webcam(str(file))
    try:
        assert webcam.duration_s == pytest.approx(2.0)
        origin_s = time.monotonic()
        webcam.start(origin_s)
        told = {}
        while webcam.statistics()["state"] != "finished":
            sighting = webcam.at(time.monotonic() - origin_s)
            if sighting is not None:
                told[sighting.face.time_s] = sighting.face.motion
        child = Path(f"/proc/{webcam._worker._supervised.child.process.pid}/fd")
        assert not [fd for fd in child.glob("*") if fd.is_symlink() and "socket" in str(fd.readlink())]
    finally:
        webcam.close()
    times_s = np.array(sorted(told))
    np.testing.assert_allclose(times_s * 20, np.round(times_s * 20), atol=1e-6)  # those of its pictures
    pitch = np.array([told[at][1] for at in times_s])
    assert pitch[times_s >= 1.1].mean() > pitch[times_s < 1.0].mean() + 0.1
    assert webcam.latency_s > 0.0
