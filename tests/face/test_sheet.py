import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_rows import motion
from PIL import Image

from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.replay.pictures import pick_instants, render_sheet
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError
from sfms_robot.face.human import load_human
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX


@pytest.fixture(scope="module")
def human():
    return load_human()


def moved(human, **channels):
    return human.vertices(motion(**channels)) - human.rest


def test_the_head_looks_along_x_with_its_left_at_plus_y(human):
    left_lid = np.abs(human.deltas[BLENDSHAPES.index("eyeBlinkLeft")]).sum(axis=1)
    middle = (left_lid @ human.rest) / left_lid.sum()
    assert middle[0] > 0.08 and middle[1] > 0.02 and abs(middle[2] - 0.03) < 0.02
    assert np.ptp(human.rest, axis=0).argmax() == 2


def test_rest_is_a_fixed_point_and_weights_add_up(human):
    np.testing.assert_allclose(human.vertices(motion()), human.rest, atol=1e-6)
    both = moved(human, eyeBlinkLeft=1, jawOpen=0.5)
    np.testing.assert_allclose(both, moved(human, eyeBlinkLeft=1) + moved(human, jawOpen=0.5), atol=1e-6)
    assert moved(human, jawOpen=1)[:, 2].min() < -0.01


def test_signs_of_the_pose_are_ours(human):
    nose = human.rest[:, 0].argmax()
    ear = human.rest[:, 1].argmin()  # the right one
    assert moved(human, pitch=0.2)[nose, 2] < -0.01
    assert moved(human, yaw=0.2)[nose, 1] > 0.01
    assert moved(human, roll=0.2)[ear, 2] < -0.01
    np.testing.assert_allclose(moved(human, z=0.01)[nose], [0, 0, 0.01], atol=1e-6)


@given(st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_the_base_of_the_neck_stays_and_the_skull_is_rigid(human, angles):
    roll, pitch, yaw = angles
    turned = human.vertices(motion(roll=roll, pitch=pitch, yaw=yaw))
    fixed = human.share == 0
    assert fixed.any() and np.abs(turned - human.rest)[fixed].max() < 1e-6
    skull = np.flatnonzero(human.share == 1)[::400]
    apart = np.linalg.norm(human.rest[skull][:, None] - human.rest[skull][None], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(turned[skull][:, None] - turned[skull][None], axis=-1), apart, atol=1e-5)


def test_brows_follow_the_skin(human):
    brows = slice(len(human.rest) - 56, None)
    assert moved(human, browInnerUp=1)[brows, 2].max() > 0.002
    assert moved(human, browDownLeft=1)[brows, 2].min() < -0.002
    assert np.isfinite(human.rest).all() and human.triangles.max() == len(human.rest) - 1


def test_a_file_that_is_no_head_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="not a head with the 52 ARKit morphs"):
        load_human(tmp_path)
    np.savez(tmp_path / "head_arkit52.npz", vertices=np.zeros((3, 3)), names=np.array(["jawOpen"]))
    with pytest.raises(ConfigError, match="head_arkit52.npz"):
        load_human(tmp_path)


def run_with_events():
    times_s = np.arange(500) / 25
    frames = np.zeros((500, 58), dtype=np.float32)

    def bump(name, at_s, height, width_s):
        frames[:, CHANNEL_INDEX[name]] += height * np.exp(-(((times_s - at_s) / width_s) ** 2))

    bump("pitch", 4.0, 0.2, 0.15)
    bump("pitch", 14.0, 0.1, 0.15)
    for side in ("Left", "Right"):
        bump(f"eyeBlink{side}", 7.0, 1.0, 0.08)
        bump(f"mouthSmile{side}", 11.0, 0.8, 0.8)
    bump("eyeLookInLeft", 17.0, 0.6, 0.3)
    bump("eyeLookOutRight", 17.0, 0.6, 0.3)
    return times_s, frames


def test_a_sheet_shows_what_happened():
    instants = pick_instants(*run_with_events())
    labels = {instant.label: instant.time_s for instant in instants}
    assert len(instants) == 12 and sorted(i.time_s for i in instants) == [i.time_s for i in instants]
    assert labels["nod, lowest"] == pytest.approx(4.0, abs=0.05)
    assert 3.4 < labels["nod begins"] < labels["nod, lowest"] < labels["nod ends"] < 4.6
    assert labels["blink"] == pytest.approx(7.0, abs=0.05)
    assert labels["smile"] == pytest.approx(11.0, abs=0.1)
    assert labels["looks right"] == pytest.approx(17.0, abs=0.1)
    assert max(np.diff([i.time_s for i in instants])) < 4.0


def test_a_still_face_gives_evenly_spread_instants():
    instants = pick_instants(np.arange(500) / 25, np.zeros((500, 58), dtype=np.float32))
    assert {instant.label for instant in instants} == {"-"}
    assert max(np.diff([instant.time_s for instant in instants])) < 3.0


@pytest.mark.parametrize("frames", [1, 5, 12])
def test_a_short_run_gives_every_frame_once(frames):
    instants = pick_instants(np.arange(frames) / 25, np.zeros((frames, 58), dtype=np.float32))
    assert [instant.row for instant in instants] == list(range(frames))


def png_size(file):
    data = file.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def test_pictures_are_drawn_without_a_display(tmp_path):
    pytest.importorskip("vtkmodules")
    times_s, frames = run_with_events()
    instants = render_sheet(tmp_path / "sheet.png", times_s, frames, times_s > 5, "a run")
    width, height = png_size(tmp_path / "sheet.png")
    assert width == pytest.approx(1600, abs=20) and 1000 < height < 1400
    assert instants == pick_instants(times_s, frames)


def test_the_robot_is_drawn_beside_the_face_and_moves(tmp_path):
    pytest.importorskip("vtkmodules")
    scene = scene_of(load_head("op3_head"))
    times_s, frames = run_with_events()
    angles_rad = np.zeros((len(times_s), 2))
    for name, tilt_rad in (("still", 0.0), ("down", 0.4)):
        angles_rad[:, 1] = tilt_rad
        render_sheet(tmp_path / f"{name}.png", times_s, frames, None, "a run", (scene, angles_rad))
    still, down = (np.asarray(Image.open(tmp_path / f"{name}.png")).astype(float) for name in ("still", "down"))
    change = np.abs(still - down).mean(axis=2)
    first = slice(8, 260), slice(268, 440)  # the virtual head and the robot, of the first instant
    face, robot = (change[80:360, columns] for columns in first)
    assert robot.mean() > 2 and face.max() == 0


def test_a_picture_needs_a_folder(tmp_path):
    pytest.importorskip("vtkmodules")
    with pytest.raises(ConfigError, match="no folder"):
        render_sheet(tmp_path / "none" / "a.png", *run_with_events())
