"""`data convert`: what goes in comes out in our space at 25 fps, and what is lost is told."""

from dataclasses import replace

import dataset_writers as write
import numpy as np
import pytest
import yaml

from sfms_robot.frames import BLENDSHAPES
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.conversion import Residual, to_ours
from sfms_robot.lab.corpora.data_commands import convert_data
from sfms_robot.lab.corpora.formats import detect, open_dataset, open_for, split_names
from sfms_robot.lab.learning.sfms.features import gather
from sfms_robot.listeners.space import COEFFICIENTS, MotionSpace, rest_of


def matrix(folder):
    """A well-conditioned FLAME matrix; what it cannot tell, gaze and tongue, has no row."""
    rows = np.random.default_rng(8).normal(0, 1, (len(BLENDSHAPES), COEFFICIENTS))
    for index, name in enumerate(BLENDSHAPES):
        if name.startswith("eyeLook") or name in ("jawOpen", "tongueOut"):
            rows[index] = 0
    write.npy(folder / "matrix.npy", rows)
    return rows


@pytest.mark.parametrize("name", ["l2l", "lm_listener", "react2025", "dualtalk", "dualtalk_arkit", "dim", "seamless"])
def test_every_convertible_set_becomes_one_that_listeners_are_trained_on(name, tmp_path):
    source = getattr(write, name)(tmp_path / "in")
    report = convert_data(source, tmp_path / "out")
    residual = report["residual"]
    if name in ("dualtalk", "react2025", "seamless"):
        assert residual["pose_round_trip_deg"] < 0.01 and residual["stored_pose_deg"] < 0.1
        assert residual["stored_blendshape"] < 1e-3
    theirs, ours = detect(source), detect(tmp_path / "out")
    assert ours[0].name == "composed" and split_names(*ours) == split_names(*theirs)
    dataset = open_for("arkit58", tmp_path / "out", "train")
    assert dataset.space == "arkit58" and dataset.fps == 25
    for split in report["splits"]:
        assert split["clips"] and not split["left_out"]
        original = open_dataset(source, split["split"])
        assert set(open_dataset(tmp_path / "out", split["split"]).names) == set(original.names)
        assert split["minutes"] == pytest.approx(original.minutes, abs=0.04 * len(original) / 60 + 1e-3)
    corpus = gather(dataset, 48, MotionSpace("arkit58", rest_of("arkit58")))
    assert sum(corpus.lengths) == sum(dataset.lengths)


def test_converted_motion_at_25_fps_is_what_decoding_the_files_gives(tmp_path):
    source = write.dualtalk(tmp_path / "in", split="test")
    convert_data(source, tmp_path / "out")
    for theirs in open_dataset(source, "test"):
        ours = clips.read(tmp_path / "out" / "test" / f"{theirs.name}.npz")
        np.testing.assert_allclose(
            ours.listener, MotionSpace("deca56", rest_of("deca56")).decode(theirs.listener)[0], atol=1e-3
        )
        np.testing.assert_allclose(ours.audio, theirs.audio, atol=1e-4)
        np.testing.assert_allclose(ours.agent_audio, theirs.agent_audio, atol=1e-4)
        np.testing.assert_array_equal(ours.listening, theirs.listening)


def test_mel_of_30_fps_is_taken_at_the_same_instants(tmp_path):
    source = write.l2l(tmp_path / "in")
    convert_data(source, tmp_path / "out")
    theirs = open_dataset(source, "test")[0]
    ours = open_dataset(tmp_path / "out", "test")[0]
    assert ours.mel.shape == (4 * len(ours.listener), 128)
    for row in (0, 40, len(ours.mel) - 1):
        complete = int((row + 1) / 100 * 120 + 1e-6) - 1
        np.testing.assert_array_equal(ours.mel[row], theirs.mel[complete])


def test_with_a_matrix_expressions_that_it_makes_are_found_again(tmp_path):
    rows = matrix(tmp_path)
    weights = np.random.default_rng(9).uniform(0.1, 0.7, (100, len(BLENDSHAPES)))
    write.dualtalk(tmp_path / "in", chats=1)
    for person in (1, 2):
        file = tmp_path / "in" / "train" / f"0000_speaker{person}.npz"
        with np.load(file) as held:
            pose = held["pose"]
        np.savez(file, exp=(weights @ rows).astype(np.float32), pose=pose)
    report = convert_data(tmp_path / "in", tmp_path / "out", flame_matrix=tmp_path / "matrix.npy")
    assert report["residual"]["expression_lost_share"] < 0.1 and report["notes"] == []
    without = convert_data(tmp_path / "in", tmp_path / "plain")["residual"]["expression_lost_share"]
    assert without == 1.0


def test_what_seamless_loses_is_units_without_a_shape_and_those_beyond_full(tmp_path):
    dyad = open_dataset(write.seamless(tmp_path / "in", 1), "train")[0]
    only = dyad.listener.copy()
    only[:, 3:] = 0
    for unit, value, share in ((19, 1.0, 1.0), (20, 1.0, 0.0), (20, 4.0, 0.5)):  # AU25, AU26, AU26
        only[:, 3 + unit] = value
        residual = Residual()
        to_ours(replace(dyad, listener=only), residual)
        assert residual.told()["expression_lost_share"] == pytest.approx(share)
        only[:, 3 + unit] = 0


def test_resampling_tells_what_25_fps_cannot_hold(tmp_path):
    dyad, found = open_dataset(write.seamless(tmp_path, 1), "train")[0], []
    for hz in (1.0, 12.0):
        motion = dyad.listener.copy()
        motion[:, :3] = 0.1 * np.sin(2 * np.pi * hz * np.arange(len(motion)) / 30 + 0.3)[:, None] * (1, 0, 0)
        residual = Residual()
        to_ours(replace(dyad, listener=motion), residual)
        found.append(residual.told()["resampling_rms_deg"])
    assert found[0] < 0.1 < 1.0 < found[1]


def test_licence_goes_along(tmp_path, caplog, command_line):
    convert_data(write.seamless(tmp_path / "in"), tmp_path / "out")
    told = yaml.safe_load((tmp_path / "out" / "source.yaml").read_text())
    assert told["layout"] == "seamless" and told["licence"].startswith("CC BY-NC 4.0")
    caplog.clear()
    open_for("arkit58", tmp_path / "out", "train")
    assert "CC BY-NC 4.0" in caplog.text
    assert command_line("data", "check", tmp_path / "out", "--json").told["licence"] == told["licence"]
    (tmp_path / "out" / "source.yaml").write_text("licence: [1]\n")
    report = command_line("data", "check", tmp_path / "out", "--json").told
    assert "source.yaml: licence = [1] is not text" in report["splits"][0]["problems"][0]["first"]


def test_an_order_that_is_given_is_taken_although_the_files_look_like_the_other(tmp_path, command_line):
    write.l2l(tmp_path / "in", pose_first=True)
    words = ("data", "convert", tmp_path / "in", tmp_path / "out")
    assert "say --order pose-first (or --order exp-first if you know better)" in command_line(*words).complaint
    assert command_line(*words, "--order", "exp-first").code == 0


@pytest.mark.parametrize(
    ("writer", "words", "said"),
    [
        ("vico", (), "vico is in deep3d73, which cannot become arkit58"),
        ("seamless", ("--layout", "smell"), "--layout smell: is not known (auto, l2l"),
        ("seamless", ("--flame-matrix", "m.npy"), "m.npy: seamless27 has no FLAME expression (deca56 has)"),
        ("dualtalk", ("--flame-matrix", "m.npy"), "--flame-matrix m.npy: no such file"),
        ("dualtalk", ("--order", "exp-first"), "there is no order to choose"),
    ],
)
def test_what_cannot_be_converted_is_one_line_and_nothing_is_written(tmp_path, command_line, writer, words, said):
    getattr(write, writer)(tmp_path / "in")
    ended = command_line("data", "convert", tmp_path / "in", tmp_path / "out", *words)
    assert ended.code == 2 and said in ended.complaint and not list(tmp_path.glob("out/*/*"))


def test_a_folder_that_holds_something_is_not_written_into_and_no_usable_clip_is_said(tmp_path, command_line):
    write.dualtalk(tmp_path / "in")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    ended = command_line("data", "convert", tmp_path / "in", tmp_path / "out")
    assert ended.code == 2 and "is not empty" in ended.complaint
    assert "is a file" in command_line("data", "convert", tmp_path / "in", tmp_path / "out" / "mine.txt").complaint
    write.seamless(tmp_path / "mute", 1)
    next((tmp_path / "mute").rglob("*.wav")).unlink()
    ended = command_line("data", "convert", tmp_path / "mute", tmp_path / "other")
    assert ended.code == 2 and "no usable clip" in ended.complaint and ".wav: no such file" in ended.complaint
    assert not list((tmp_path / "other").iterdir())
