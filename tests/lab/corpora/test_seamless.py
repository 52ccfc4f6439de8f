"""Seamless Interaction, on tiny interactions in its layout."""

import json
import shutil

import dataset_writers as write
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ
from sfms_robot.lab.corpora import formats
from sfms_robot.lab.corpora.clips import FAU_VALUE, WITHOUT_UNIT, blendshapes_of
from sfms_robot.lab.corpora.conversion import Residual, in_ours, to_ours
from sfms_robot.lab.corpora.data_commands import check_data
from sfms_robot.lab.corpora.external.seamless import stretches
from sfms_robot.lab.corpora.formats import detect, open_dataset, open_for
from sfms_robot.signals.audio import read_audio

ONE, TWO = f"{write.SEAMLESS_ID}_P0947", f"{write.SEAMLESS_ID}_P0948A"
ROTATION, UNITS, VALID = (f"movement:{key}" for key in ("alignment_head_rotation", "FAUValue", "is_valid"))


def file_of(root, name, ending, split="train"):
    return next((root / "improvised" / split).rglob(f"{name}{ending}"))


def scanned(root, split="train"):
    return formats.scan_split(*detect(root), split)


def rewritten(file, **arrays):
    """The .npz with some arrays replaced, or left out where they are None."""
    with np.load(file) as held:
        rows = {**held, **arrays}
    np.savez_compressed(file, **{key: value for key, value in rows.items() if value is not None})


def rows_of(root, name, key):
    with np.load(file_of(root, name, ".npz")) as held:
        return held[key]


def test_partners_swapped_give_the_swapped_dyad(tmp_path):
    write.seamless(tmp_path, interactions=1)
    one, two = open_dataset(tmp_path, "train")
    assert (one.name, two.name) == (f"{ONE}_f00000", f"{TWO}_f00000")
    np.testing.assert_array_equal(one.speaker, two.listener)
    np.testing.assert_array_equal(two.speaker, one.listener)
    np.testing.assert_array_equal(one.audio, two.agent_audio)
    np.testing.assert_array_equal(two.audio, one.agent_audio)
    assert not (one.listening & two.listening).all() and one.listening.any() and two.listening.any()


def test_a_listener_hears_his_partner_and_listens_while_that_one_speaks(tmp_path):
    write.seamless(tmp_path, interactions=1, frames=300)
    one = open_dataset(tmp_path, "train")[0]  # 0947 listens to 0948A
    np.testing.assert_array_equal(one.audio, read_audio(file_of(tmp_path, TWO, ".wav")))
    for start, end in write.seamless_speech(10.0, first=False):
        assert one.listening[int(start * 30) + 1 : int(end * 30)].all()
    for start, end in write.seamless_speech(10.0, first=True):
        assert not one.listening[int(start * 30) + 1 : int(end * 30)].any()


def test_converted_motion_keeps_its_place_in_time(tmp_path):
    """A face that moves in proportion to time does so at 25 fps too, from the same instant, also in a later stretch."""
    frames = 360
    ramp = np.linspace(0.0, 0.36, frames)
    rotation = np.stack([ramp, np.zeros(frames), np.zeros(frames)], axis=1).astype(np.float32)
    units = (0.1 + np.tile(ramp[:, None], (1, 24))).astype(np.float32)
    valid = np.ones((frames, 1), np.float32)
    valid[120:180] = 0
    write.seamless(tmp_path, 1, frames, **{ROTATION: rotation * valid, UNITS: units * valid, VALID: valid})
    dataset, rest = open_dataset(tmp_path, "train"), np.median(ramp[valid[:, 0] > 0])
    for dyad, first in zip(dataset[:2], (0, 182), strict=True):
        ours = to_ours(dyad, Residual())
        ends_s = first / 30 + np.maximum((np.arange(len(ours.listener)) + 1) / FRAME_HZ, 1 / 30)
        wanted = np.interp(ends_s * 30 - 1, np.arange(frames), ramp)
        np.testing.assert_allclose(ours.listener[:, CHANNEL_INDEX["pitch"]], wanted - rest, atol=1e-5)
        np.testing.assert_allclose(ours.listener[:, CHANNEL_INDEX["jawOpen"]], (0.1 + wanted) / 2, atol=1e-5)
        heard = read_audio(file_of(tmp_path, TWO, ".wav"))[round(first / 30 * 16_000) :][: len(ours.audio)]
        np.testing.assert_array_equal(ours.audio, heard)


@pytest.mark.parametrize(
    ("axis", "channel"), [(0, "pitch"), (1, "yaw"), (2, "roll")], ids=["nose down", "to the own left", "right ear down"]
)
def test_signs_are_those_of_flame(axis, channel):
    rows = np.zeros((1, 27), np.float32)
    rows[0, axis], rows[0, 3] = 0.3, 1.0
    pose = in_ours(rows, "seamless27")[0, :6]
    assert pose[CHANNEL_INDEX[channel]] == pytest.approx(0.3, abs=1e-6)
    assert np.abs(np.delete(pose, CHANNEL_INDEX[channel])).max() < 1e-6


def test_heads_are_turned_from_where_they_mostly_are(tmp_path):
    """Somebody who sits turned by 40 degrees and nods, nods: no part of it becomes a tilt."""
    times_s = np.arange(240) / 30
    nods = Rotation.from_rotvec(np.outer(0.2 * np.sin(4 * times_s), [1, 0, 0]))
    turned = (Rotation.from_rotvec([0, 0.7, 0]) * nods).as_rotvec().astype(np.float32)
    write.seamless(tmp_path, 1, **{ROTATION: turned})
    pose = to_ours(open_dataset(tmp_path, "train")[0], Residual()).listener[:, :3]
    assert np.ptp(pose[:, 1]) == pytest.approx(0.4, abs=0.02) and np.abs(pose[:, [0, 2]]).max() < 0.02


def test_invalid_frames_are_cut_of_a_listener_and_unknown_of_a_speaker(tmp_path):
    write.seamless(tmp_path, 1, frames=360, invalid=((120, 180),))
    dataset = open_dataset(tmp_path, "train")
    assert dataset.names[:2] == (f"{ONE}_f00000", f"{ONE}_f00182") and dataset.lengths == (118, 178) * 2
    assert all(np.isfinite(dyad.listener).all() for dyad in dataset)
    folder = tmp_path / "other"
    write.seamless(folder, 1, frames=360)
    valid = np.ones((360, 1), np.float32)
    valid[120:180] = 0
    file = file_of(folder, TWO, ".npz")
    rewritten(file, **{VALID: valid, **{key: rows_of(folder, TWO, key) * valid for key in (ROTATION, UNITS)}})
    one = open_dataset(folder, "train")[0]
    assert len(one.listener) == 360
    np.testing.assert_array_equal(np.isfinite(one.speaker).all(axis=1), valid[:, 0] > 0)
    ours = np.isfinite(to_ours(one, Residual()).speaker).all(axis=1)
    assert ours[:99].all() and not ours[101:149].any() and ours[151:].all()


def test_stretches_keep_off_the_edges_and_are_long_enough():
    valid = np.ones(400, bool)
    valid[70:80] = valid[140:150] = valid[220:230] = False
    assert stretches(valid) == [(0, 68), (152, 218), (232, 400)]
    assert stretches(np.zeros(300, bool)) == [] and stretches(np.ones(59, bool)) == []


def test_every_unit_with_a_shape_moves_it_and_nothing_else():
    for column, unit in enumerate(FAU_VALUE):
        rows = np.zeros((1, 24))
        rows[0, column] = 2.0
        shapes = blendshapes_of(rows)[0]
        moved = {name for name, at in CHANNEL_INDEX.items() if at >= 6 and shapes[at - 6]}
        assert not moved & set(WITHOUT_UNIT)
        assert bool(moved) == (unit not in (23, 25, 30)), unit
    assert blendshapes_of(np.full((1, 24), 9.0)).max() == 1.0 and blendshapes_of(np.full((1, 24), -1.0)).min() == 0.0


@pytest.mark.parametrize("mirrored", [False, True])
def test_key_points_tell_which_way_heads_turn(mirrored, tmp_path):
    write.seamless(tmp_path, 2)
    for name in (f"V00_S{session}_I00000582_P{person}" for session in ("0809", "0810") for person in ("0947", "0948A")):
        file, units = file_of(tmp_path, name, ".npz"), rows_of(tmp_path, name, UNITS)
        points = write.seen(rows_of(tmp_path, name, ROTATION), units[:, FAU_VALUE.index(26)], units[:, -1], mirrored)
        rewritten(file, **{"boxes_and_keypoints:keypoints": points})
    dataset = open_dataset(tmp_path, "train")
    note = dataset.notes[-1]
    assert "key points of 4 files" in note and "pitch +" in note and "jaw drop +1.00" in note
    assert ("yaw and roll are turned" in note) == mirrored
    vectors = rows_of(tmp_path, ONE, ROTATION).astype(float) * ((1, -1, -1) if mirrored else (1, 1, 1))
    rest = Rotation.from_rotvec(np.median(vectors, axis=0))
    wanted = (rest.inv() * Rotation.from_rotvec(vectors)).as_rotvec()
    np.testing.assert_allclose(dataset[0].listener[:, :3], wanted, atol=1e-6)


def test_without_key_points_signs_are_unverified_and_archives_still_packed_are_named(tmp_path):
    assert "unverified" in scanned(write.seamless(tmp_path)).notes[-1]
    (tmp_path / "improvised/train/0000/0044.tar").write_bytes(b"")
    assert "0044.tar" in str(scanned(tmp_path).problems[0]) and "unpack" in str(scanned(tmp_path).problems[0])


def test_newer_movement_replaces_the_older(tmp_path):
    write.seamless(tmp_path, 1)
    newer = {f"movement_v4:{key.split(':')[1]}": rows_of(tmp_path, ONE, key) for key in (ROTATION, UNITS, VALID)}
    newer["movement_v4:FAUValue"] = newer["movement_v4:FAUValue"] / 2
    rewritten(file_of(tmp_path, ONE, ".npz"), **newer)
    one = open_dataset(tmp_path, "train")[0]
    np.testing.assert_allclose(one.listener[:, 3:], newer["movement_v4:FAUValue"], atol=1e-6)


def test_both_labels_are_one_set_and_one_label_is_one_too(tmp_path):
    write.seamless(tmp_path, 1)
    write.seamless(tmp_path / "more", 1, split="dev")
    shutil.move(tmp_path / "more" / "improvised", tmp_path / "naturalistic")
    assert formats.split_names(*detect(tmp_path)) == ("train", "validation")
    assert len(open_dataset(tmp_path, "val")) == 2
    assert formats.split_names(*detect(tmp_path / "naturalistic")) == ("validation",)


def test_check_says_what_was_found_and_under_which_licence(tmp_path, command_line):
    write.seamless(tmp_path, invalid=((60, 90),))
    ended = command_line("data", "check", tmp_path)
    assert ended.code == 0 and "CC BY-NC 4.0" in ended.out
    assert "4 people in 2 interactions; files: .npz 4, .json 4, .wav 4, .mp4 0" in ended.out
    assert "12.5% of 0.5 minutes of faces are invalid and cut" in ended.out
    assert "AU23, AU25, AU30" in ended.out and "eyeLookInLeft" in ended.out
    assert command_line("data", "check", tmp_path, "--json").told["licence"].startswith("CC BY-NC 4.0")


def test_training_on_them_names_the_licence_and_unconverted_the_way(tmp_path, caplog):
    open_dataset(write.seamless(tmp_path), "train")
    assert "CC BY-NC 4.0" in caplog.text
    with pytest.raises(ConfigError, match="seamless27, which cannot become arkit58; `sfms-robot data convert`"):
        open_for("arkit58", tmp_path, "train")


def vad(change):
    def harm(root):
        file = file_of(root, ONE, ".json")
        told = json.loads(file.read_text())
        change(told["metadata:vad"])
        file.write_text(json.dumps(told))

    return harm


HARMS = {
    "no npz": (lambda root: file_of(root, ONE, ".npz").unlink(), "missing half", f"{ONE}.npz", "no such file"),
    "no json": (lambda root: file_of(root, ONE, ".json").unlink(), "missing half", f"{ONE}.json", "no such file"),
    "no wav": (lambda root: file_of(root, ONE, ".wav").unlink(), "missing sound", f"{ONE}.wav", "no such file"),
    "no partner": (
        lambda root: [file_of(root, ONE, ending).unlink() for ending in (".npz", ".json", ".wav")],
        "missing half", write.SEAMLESS_ID, f"the partner's files are not here: {TWO}",
    ),
    "no movement": (
        lambda root: rewritten(file_of(root, ONE, ".npz"), **{ROTATION: None, UNITS: None, VALID: None}),
        "missing half", f"{ONE}.npz", f"has no {ROTATION}, {UNITS}, {VALID} (only movement, smplh",
    ),
    "wrong shape": (
        lambda root: rewritten(file_of(root, ONE, ".npz"), **{UNITS: np.ones((240, 17), np.float32)}),
        "wrong dims", f"{ONE}.npz", "movement:FAUValue has shape (240, 17), expected (240, 24)",
    ),
    "shorter rows": (
        lambda root: rewritten(file_of(root, ONE, ".npz"), **{VALID: np.ones((100, 1), np.float32)}),
        "wrong dims", f"{ONE}.npz", "movement:is_valid has shape (100, 1), expected (240, 1)",
    ),
    "cut wav": (
        lambda root: write.wav(file_of(root, ONE, ".wav"), 2.0, 48_000),
        "lengths differ", f"{ONE}.wav", "2.00 s of sound for 8.00 s of face",
    ),
    "no sound in the wav": (
        lambda root: write.wav(file_of(root, ONE, ".wav"), 0.0, 48_000), "unreadable", f"{ONE}.wav", "holds no samples",
    ),
    "partners of other lengths": (
        lambda root: write.seamless_person(file_of(root, ONE, ".npz").parent, ONE, frames=150),
        "lengths differ", write.SEAMLESS_ID, "240 frames beside 150",
    ),
    "speech after the end": (
        vad(lambda spans: spans.append({"start": 7.0, "end": 12.0})),
        "time stamps", f"{ONE}.json", "metadata:vad[2] ends at 12.00 s, the interaction at 8.00 s",
    ),
    "speech that goes back": (
        vad(lambda spans: spans.reverse()), "time stamps", f"{ONE}.json", "begins at 0.3 s, before the one before it",
    ),
    "speech that ends before it begins": (
        vad(lambda spans: spans[0].update(start=1.9)),
        "time stamps", f"{ONE}.json", "metadata:vad[0] goes from 1.9 to 1.8 s",
    ),
    "no annotation": (
        lambda root: file_of(root, ONE, ".json").write_text("{}"), "unreadable", f"{ONE}.json", "metadata:vad",
    ),
    "zeros said to be valid": (
        lambda root: rewritten(file_of(root, ONE, ".npz"), **{UNITS: np.zeros((240, 24), np.float32)}),
        "not finite", f"{ONE}.npz", "240 of 240 frames from 0 on are zeros and said to be valid",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HARMS)
def test_one_harm_is_one_line_that_names_the_file_and_the_rest_is_usable(name, tmp_path):
    harm, kind, where, detail = HARMS[name]
    write.seamless(tmp_path)
    harm(tmp_path)
    report = check_data(tmp_path)
    (split,) = report["splits"]
    (problem,) = split["problems"]
    assert problem["kind"] == kind and where in problem["names"][0] and detail in problem["first"]
    assert report["usable"] and split["clips"] >= 2


def test_a_voice_beside_its_annotation_is_a_wrong_time_stamp(tmp_path):
    write.seamless(tmp_path, 1, frames=600)
    write.seamless_person(tmp_path / "improvised/train/0000/0005", ONE, 600, late_s=0.8)
    (problem,) = check_data(tmp_path)["splits"][0]["problems"]
    assert problem["kind"] == "time stamps" and problem["count"] == 2  # of both clips
    assert "the voice comes +0.8" in problem["first"] and f"metadata:vad of {ONE}" in problem["first"]
