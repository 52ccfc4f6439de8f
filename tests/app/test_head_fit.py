"""A head fitted from sight: the virtual face, whose skin nobody knows, looks more like what was asked."""

import json

import numpy as np
import pytest

from sfms_robot.app.head import fit as fitting
from sfms_robot.app.head.head_check import fidelity, named_faces
from sfms_robot.app.options import HeadOptions
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.config import load_head
from sfms_robot.config.overlay import load_overlay, overlay_file
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_S, SHAPES
from sfms_robot.retarget.channel_mapping import Units
from sfms_robot.retarget.response_fit import asked, fit, fitted_drives, looks_like, rms
from sfms_robot.signals.tracks import Track, write_track


def recorded_shapes():
    return np.concatenate([clip[::3, SHAPES] for _, clip in named_faces() if clip[:, SHAPES].any()])


def named_clip(kind):
    """Return the first 200 frames of the first bundled clip of a kind."""
    return next(clip[:200] for name, clip in named_faces() if name == kind)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_held_out_faces_come_three_times_nearer(seed, record_property):
    head = load_head("face28")
    units, rng, joints = Units.of(head), np.random.default_rng(seed), len(head.joints)
    shapes = recorded_shapes()
    held_out = np.arange(len(shapes)) // 50 % 4 == 3
    tracker = fitting.Tracker(head, fitting.hidden_skin(joints, seed))
    ideal = fitting.Tracker(head)

    train = asked(head, shapes[~held_out])
    responses = fit(train, looks_like(head, tracker.seen(train, rng)), units.low, units.high)
    drives = fitted_drives(head, responses)
    joints_fitted = {n: j.model_copy(update={"drive": drives.get(n, j.drive)}) for n, j in head.joints.items()}
    fitted = head.model_copy(update={"joints": joints_fitted})

    test = shapes[held_out]
    told, skin = asked(head, test), fitting.skin_motion()
    best, errors = ideal.face(told), {}
    for name, candidate in (("before", head), ("after", fitted)):
        face = tracker.face(asked(candidate, test))
        missed = face - best
        way = np.sqrt(np.einsum("ni,ij,nj->n", missed, skin, missed, optimize=True).mean())
        errors[name] = np.array([rms(looks_like(head, face) - told), way, rms(missed)])
    ratios = errors["before"] / errors["after"]
    record_property("times smaller in joint units, on the skin, per blendshape", ratios.round(2).tolist())
    assert (ratios >= 3).all(), ratios


def test_the_virtual_face_without_a_skin_of_its_own_looks_as_asked():
    head = load_head("face28")
    told = asked(head, recorded_shapes()[::5])
    face = fitting.Tracker(head).face(told)
    assert face.min() >= 0 and face.max() <= 1 and rms(looks_like(head, face) - told) < 0.01


@pytest.fixture(scope="module")
def babbled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("babble")
    report = fitting.babble(HeadOptions(head="inmoov2_maestro", fast=True), folder, minutes=0.1, seed=2)
    fitting.see_virtual_face("inmoov2_maestro", folder)
    return folder, report


@pytest.mark.slow
def test_babbling_keeps_to_the_limits_and_is_learnt_from(babbled, monkeypatch, tmp_path):
    folder, report = babbled
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert report["limits"]["violations"] == 0 and report["exit"] == "done"
    result = fitting.fit_head("inmoov2_maestro", folder)
    assert result["after"] < result["before"]
    json.dumps(result)
    head = load_head("inmoov2_maestro")
    practice = overlay_file(head.name, practice=True)
    assert load_overlay(head, practice).fit is not None and not overlay_file(head.name).exists()
    assert result["practice"] and result["file"] == str(practice)


@pytest.mark.slow
def test_what_is_no_recording_of_this_face_is_told(babbled, tmp_path):
    folder, head = babbled[0], load_head("inmoov2_maestro")
    (tmp_path / "run.mcap").write_bytes((folder / "run.mcap").read_bytes())
    run = read_recording(folder)
    with pytest.raises(ConfigError, match=r"has no face\.csv"):
        fitting.read_pairs(head, tmp_path, run)
    with pytest.raises(ConfigError, match="without joint"):
        fitting.read_pairs(load_head("face28"), folder, run)


def test_random_faces_begin_and_end_at_rest_and_stay_faces():
    faces = fitting.random_faces([0, 5, 9], 30.0, seed=1)
    motion, _ = faces.sample(np.arange(0, faces.duration_s, 0.01), 0.0, None)
    assert not motion[0].any() and np.abs(motion[-1]).max() < 0.01 and motion.min() >= 0 and motion.max() <= 1
    assert np.flatnonzero(motion.any(axis=0)).tolist() == [6, 11, 15]
    assert np.abs(np.diff(motion, axis=0)).max() < 0.05


def test_a_face_shows_more_of_a_face_than_a_neck_does(tmp_path):
    motion = {"brows": named_clip("brows"), "heads": named_clip("heads")}
    for name, clip in motion.items():
        write_track(tmp_path / f"{name}.csv", Track(FRAME_S * np.arange(len(clip)), clip, frozenset(CHANNELS)))
    rows = {(row["head"], row["face"]): row for row in fidelity(["face28", "op3_head"], tmp_path)["rows"]}
    assert rows["face28", "all"]["expression"] > 0.5 and rows["op3_head", "all"]["expression"] == 0
    assert rows["face28", "brows.csv"]["expression"] > 0.9 and rows["face28", "brows.csv"]["pose"] is None
    assert rows["face28", "heads.csv"]["pose"] > 0.9 and rows["face28", "heads.csv"]["expression"] is None


def test_where_no_file_can_be_written_nothing_moves(tmp_path, monkeypatch, command_line):
    """A calibration asks nothing and a babble records nothing before the folder of their result is there."""
    (tmp_path / "config").write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    for command in (["calibrate", "op3_head", "--port", "sim"], ["fit", "op3_head", "--babble", "--record", tmp_path]):
        ended = command_line("head", *command)
        assert ended.code == 2 and "config" in ended.err and "cannot be written" in ended.err
        assert "Enter" not in ended.out and not (tmp_path / "run.mcap").exists()
