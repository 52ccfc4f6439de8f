"""Each layout, on tiny files written in it."""

import pickle
from collections.abc import Callable
from pathlib import Path

import dataset_writers as write
import numpy as np
import pytest
import torch
from made_dyads import made_dyad
from scipy.spatial.transform import Rotation

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX
from sfms_robot.lab.corpora import clips, formats
from sfms_robot.lab.corpora.clips import WIDTHS, Dyad
from sfms_robot.lab.corpora.collection import ClipError
from sfms_robot.lab.corpora.external import react
from sfms_robot.lab.corpora.formats import LAYOUTS, detect, looks_like, open_dataset, open_for, split_names
from sfms_robot.lab.learning.sfms.features import gather
from sfms_robot.listeners.audio_frontend import AudioFrontend
from sfms_robot.listeners.space import MotionSpace, rest_of
from sfms_robot.signals.audio import read_audio


def composed(root: Path) -> Path:
    for split in ("train", "validation"):
        clips.save(root / split, [plain(f"a_{split}"), plain(f"b_{split}", frames=80)])
    return root


def plain(name: str, frames: int = 60, **more) -> Dyad:
    motion = write.RNG.uniform(0, 0.5, (frames, 58)).astype(np.float32)
    audio = write.RNG.normal(0, 0.1, frames * 640).astype(np.float32).clip(-1, 1)
    return made_dyad(motion, name=name, audio=audio, speaker=motion[::-1].copy(), **more)


WRITERS: dict[str, Callable[[Path], Path]] = {
    "l2l": write.l2l, "lm_listener": write.lm_listener, "react": write.react, "react2025": write.react2025,
    "dualtalk": write.dualtalk, "dualtalk_arkit": write.dualtalk_arkit, "dim": write.dim, "vico": write.vico,
    "seamless": write.seamless, "composed": composed,
}  # fmt: skip


def test_every_layout_has_a_writer_here():
    assert set(WRITERS) == set(LAYOUTS)


@pytest.mark.parametrize("name", WRITERS)
def test_layout_is_detected_its_clips_are_what_headers_promised_and_features_come_along_when_asked_for(name, tmp_path):
    WRITERS[name](tmp_path)
    layout, place = detect(tmp_path)
    assert layout.name == name
    for split in split_names(layout, place):
        dataset = formats.scan_split(layout, place, split)
        assert not dataset.problems and dataset.space == layout.space and dataset.fps == layout.fps
        assert len(set(dataset.names)) == len(dataset)
        for dyad, dyad_name, length in zip(dataset, dataset.names, dataset.lengths, strict=True):
            assert dyad.name == dyad_name and dyad.space == dataset.space and dyad.fps == dataset.fps
            assert dyad.listener.shape == (length, WIDTHS[dataset.space]) and dyad.listener.dtype == np.float32
    split = split_names(layout, place)[0]
    wanted = [*open_dataset(tmp_path, split).clips[0].features]
    assert wanted or name not in ("react", "react2025", "dim", "vico")
    dyad = open_dataset(tmp_path, split, features=wanted)[0]
    assert list(dyad.features) == wanted
    assert all(rows.shape[0] == len(dyad.listener) for rows in dyad.features.values())
    with pytest.raises(ConfigError, match="has no smell"):
        open_dataset(tmp_path, split, features=["smell"])[0]


@pytest.mark.parametrize("name", ["l2l", "dualtalk"])
def test_held_out_and_train_are_apart_and_the_same_every_time(name, tmp_path):
    WRITERS[name](tmp_path)
    if name == "dualtalk":
        write.dualtalk(tmp_path, chats=10)
    first, again = (set(open_dataset(tmp_path, "validation").names) for _ in range(2))
    train = set(open_dataset(tmp_path, "train").names)
    assert first == again and first and not first & train
    assert len(first) / (len(first) + len(train)) == pytest.approx(LAYOUTS[name].held_out, abs=0.06)


def test_l2l_host_listens_to_the_guest_and_mel_becomes_natural_log(tmp_path):
    write.l2l(tmp_path)
    write.l2l(tmp_path, "fallon", test=2)
    write.l2l(tmp_path, "devi2")
    dataset = open_dataset(tmp_path, "test")
    assert [name.split("_p")[0] for name in dataset.names] == ["conan_test"] * 2 + ["fallon_test"] * 3
    assert any("devi2" in note for note in dataset.notes)
    folder, dyad = tmp_path / "fallon" / "test", dataset[4]
    for values, file in ((dyad.listener, "p1_list_faces"), (dyad.speaker, "p0_speak_faces")):
        np.testing.assert_array_equal(values, np.load(folder / f"{file}_clean_deca.npy")[2, :, :56])
    power = np.load(folder / "p0_speak_audio_clean_deca.npy")[2]
    np.testing.assert_allclose(np.exp(dyad.mel), power, rtol=1e-3, atol=1e-5)
    assert dyad.audio is None and dyad.mel_rows() is dyad.mel


def test_l2l_decibels_are_told_from_power(tmp_path):
    write.l2l(tmp_path)
    file = tmp_path / "conan" / "test" / "p1_speak_audio_clean_deca.npy"
    power = np.load(file)
    np.save(file, 10 * np.log10(power))
    np.testing.assert_allclose(np.exp(open_dataset(tmp_path, "test")[0].mel), power[0], rtol=1e-3)


def test_l2l_files_are_mapped_not_read(tmp_path):
    """A file whose last clips are cut off on disk still gives its first: nobody read it whole."""
    dataset = open_dataset(write.l2l(tmp_path), "test")
    first = dataset[0].listener.copy()
    file = tmp_path / "conan" / "test" / "p0_list_faces_clean_deca.npy"
    with file.open("r+b") as stream:  # the second clip's bytes become NaN, the first's stay
        stream.seek(-4 * 64 * 184, 2)
        stream.write(b"\xff" * (4 * 64 * 184))
    np.testing.assert_array_equal(dataset[0].listener, first)
    with pytest.raises(ClipError, match="64 of 64 frames"):
        dataset[1]


def test_lm_listener_p0_listens(tmp_path):
    write.lm_listener(tmp_path)
    segment = torch.load(tmp_path / "trevor" / "segments_val.pth", weights_only=True)[1]
    dyad = open_dataset(tmp_path, "val")[1]
    np.testing.assert_array_equal(dyad.listener, torch.cat([segment["p0_exp"], segment["p0_pose"]], 1))
    np.testing.assert_array_equal(dyad.speaker, torch.cat([segment["p1_exp"], segment["p1_pose"]], 1))
    assert dyad.audio is None and dyad.mel_rows() is None


def test_lm_listener_arrays_are_read_and_other_objects_are_refused(tmp_path):
    write.lm_listener(tmp_path, hubert_feat=np.zeros((70, 8), np.float32), lengths=(70,))
    assert open_dataset(tmp_path, "test", features=["hubert"])[0].features["hubert"].shape == (70, 8)
    write.lm_listener(tmp_path, path=Path("x"), lengths=(70,))
    with pytest.raises(ConfigError, match=r"segments_test.pth: holds more than tensors"):
        open_dataset(tmp_path, "test")


def test_lm_listener_joined_folder_gives_way_to_its_parts(tmp_path):
    for subject in ("trevor", "conan", "trevorconan"):
        write.lm_listener(tmp_path / "dataset", subject)
    assert {name.split("_")[0] for name in open_dataset(tmp_path, "train").names} == {"trevor", "conan"}


def test_react_pairs_are_mirrored_in_the_order_of_the_matrix(tmp_path):
    dataset = open_dataset(write.react(tmp_path, frames=751), "validation")
    people = [name.split("+")[2] for name in dataset.names]
    assert people == ["Novice_video"] * 2 + ["Expert_video"] * 2
    assert [clip.row for clip in dataset.clips] == [0, 1, 2, 3] and dataset.lengths == (750,) * 4
    np.testing.assert_array_equal(dataset[0].speaker, dataset[2].listener)


def test_react_row_survives_clips_that_are_left_out(tmp_path):
    write.react(tmp_path)
    (tmp_path / "val" / "3D_FV_files" / "NoXI/000_Paris/Expert_video/1.npy").unlink()
    dataset = open_dataset(tmp_path, "val")
    assert [clip.row for clip in dataset.clips] == [1, 3]
    assert [problem.kind for problem in dataset.problems] == ["missing half"]


def test_react_attributes_are_those_of_the_listener_under_either_name(tmp_path):
    dataset = open_dataset(write.react(tmp_path), "val", features=["attributes", "speaker_attributes"])
    novice = react.attributes(tmp_path / "val", "NoXI/000_Paris/P2/1", 101)
    np.testing.assert_array_equal(dataset[0].features["attributes"], novice)
    np.testing.assert_array_equal(dataset[2].features["speaker_attributes"], novice)


def test_a_listener_is_given_data_in_its_own_space_or_in_one_that_becomes_it(tmp_path):
    faces, deca = write.react(tmp_path / "react"), write.l2l(tmp_path / "l2l")
    for space, given in (("faceverse58", "faceverse58"), ("arkit58", "arkit58")):
        dataset = open_for(space, faces, "validation")
        assert dataset.space == dataset[0].space == given
    assert open_for("deca56", deca, "train")[0].space == "deca56"
    with pytest.raises(ConfigError, match="l2l is in deca56, which cannot become arkit58"):
        open_for("arkit58", deca, "train")


def test_a_listener_is_given_the_features_that_its_data_ship(tmp_path):
    write.react2025(tmp_path)
    shipped, *_ = open_for("arkit58", tmp_path, "train", features=["wav2vec2"])
    assert shipped.space == "arkit58" and shipped.features["wav2vec2"].shape == (len(shipped.listener), 768)
    frontend = AudioFrontend("wav2vec2")
    sound = gather([shipped], 48, MotionSpace("arkit58", rest_of("arkit58")), frontend).frames.sound
    np.testing.assert_allclose(sound[:, 0], shipped.features["wav2vec2"], rtol=1e-3, atol=1e-4)
    assert not open_for("arkit58", tmp_path, "train", features=["mel"])[0].features


def test_react2025_feature_that_ends_a_frame_early_is_filled(tmp_path):
    dyad = open_dataset(write.react2025(tmp_path), "train", features=["wav2vec2"])[0]
    assert dyad.features["wav2vec2"].shape == (60, 768) and dyad.audio.shape == (32_000,)
    assert dyad.mel_rows().shape == (240, 128)


def test_dualtalk_each_listens_to_the_other_and_has_both_voices(tmp_path):
    one, two = open_dataset(write.dualtalk(tmp_path, chats=1, split="test"), "test")
    np.testing.assert_array_equal(one.speaker, two.listener)
    np.testing.assert_array_equal(one.audio, two.agent_audio)
    np.testing.assert_array_equal(one.agent_audio, two.audio)
    assert one.audio.shape == (100 * 640,) and not np.array_equal(one.audio, two.audio)


def test_dualtalk_demo_has_two_voices_and_one_face_and_whose_face_is_there_listens(tmp_path):
    write.dualtalk_demo(tmp_path)
    for folder in (tmp_path, tmp_path / "demo"):
        dataset = open_dataset(folder, "demo")
        assert dataset.names == ("abc_sub_video_0_000_speaker2", "abc_sub_video_1_000_speaker1")
        dyad = dataset[0]
        assert np.isnan(dyad.speaker).all() and dyad.fps == 25 and dyad.space == "deca56"
        heard, said = (read_audio(tmp_path / "demo" / f"abc_sub_video_0_000_speaker{person}.wav") for person in (1, 2))
        np.testing.assert_array_equal(dyad.audio[: len(heard)], heard)
        np.testing.assert_array_equal(dyad.agent_audio[: len(said)], said)


def test_dualtalk_in_arkit_s_shapes_is_found_before_the_one_in_flame_s_and_stands_in_our_order(tmp_path):
    write.dualtalk_arkit(tmp_path, split="test")
    dyad = open_dataset(tmp_path, "test")[0]
    rows = np.load(tmp_path / "ARKit_npy" / "test" / "0000_speaker1.npy")
    assert dyad.name == "0000_speaker1" and dyad.space == "arkit58" and dyad.agent_audio is not None
    columns = [CHANNEL_INDEX[name] for name in ("yaw", "pitch", "roll")]
    np.testing.assert_array_equal(dyad.listener[:, columns], rows[:, 52:55])
    for name, column in (("eyeBlinkLeft", 0), ("jawLeft", 15), ("jawOpen", 17), ("noseSneerRight", 50)):
        np.testing.assert_array_equal(dyad.listener[:, CHANNEL_INDEX[name]], rows[:, column])
    assert open_dataset(tmp_path, "test", layout="dualtalk").space == "deca56"


def test_dualtalk_angles_in_arkit_s_edition_are_the_turns_of_flame_s(tmp_path):
    """What its authors computed from FLAME's rotation vector is what reading FLAME's own files gives."""
    write.dualtalk_arkit(tmp_path, chats=1, split="test")
    with np.load(tmp_path / "test" / "0000_speaker1.npz") as arrays:
        vectors = arrays["pose"][:, :3].astype(float)
    file = tmp_path / "ARKit_npy" / "test" / "0000_speaker1.npy"
    rows = np.load(file)
    rows[:, 52:55] = Rotation.from_rotvec(vectors).as_euler("YXZ")
    np.save(file, rows)
    arkit = open_dataset(tmp_path, "test")[0]
    filed = open_dataset(tmp_path, "test", layout="dualtalk")[0].listener
    flame = MotionSpace("deca56", rest_of("deca56")).decode(filed)[0]
    np.testing.assert_allclose(arkit.listener[:, :3], flame[:, :3], atol=1e-6)


def test_dim_pickle_that_would_run_code_is_refused(tmp_path):
    write.dim(tmp_path)

    class Evil:
        def __reduce__(self):
            return (print, ("ran",))

    (tmp_path / "vico_processed_30fps" / "id0.pkl").write_bytes(pickle.dumps({"audio": Evil()}))
    problems = formats.scan_split(*detect(tmp_path), "test").problems
    problems += formats.scan_split(*detect(tmp_path), "train").problems
    assert [problem.kind for problem in problems] == ["unreadable"]
    assert "builtins.print: only arrays" in problems[0].detail


def test_dim_pickles_of_both_numpy_generations_are_read(tmp_path):
    write.dim(tmp_path)
    for file in (tmp_path / "vico_processed_30fps").glob("*.pkl"):
        old = pickle.dumps(pickle.loads(file.read_bytes()), protocol=2).replace(b"numpy._core", b"numpy.core")
        file.write_bytes(old)
    assert open_dataset(tmp_path, "test")[0].listener.shape == (100, 56)


@pytest.mark.parametrize(
    ("name", "writer", "right", "wrong"),
    [
        ("l2l", write.l2l, "exp-first", "pose-first"),
        ("react", write.react, "exp-first", "pose-first"),
        ("dim", write.dim, "pose-first", "exp-first"),
    ],
)
def test_files_in_the_other_order_are_refused_unless_it_is_said(name, writer, right, wrong, tmp_path):
    writer(tmp_path / "right")
    writer(tmp_path / "wrong", pose_first=wrong == "pose-first")
    split = "val" if name == "react" else "test"
    assert (
        looks_like([d.listener for d in open_dataset(tmp_path / "right", split)], LAYOUTS[name].space, right) == right
    )
    with pytest.raises(ConfigError, match=rf"look {wrong}, not {right}: say --order {wrong}"):
        open_dataset(tmp_path / "wrong", split)
    turned = open_dataset(tmp_path / "wrong", split, order=wrong)
    assert looks_like([turned[0].listener], turned.space, wrong) == wrong
    assert turned[0].listener[:, -6:][:, 4:].std(axis=0).max() < 0.1


@pytest.mark.parametrize(
    "motion", [np.zeros((50, 56)), np.ones((50, 56)), np.random.default_rng(0).normal(size=(50, 56))]
)
def test_order_that_cannot_be_told_is_not_guessed(motion):
    assert looks_like([motion.astype(np.float32)], "deca56", "exp-first") is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layout": "l3l"}, r"--layout l3l: is not known \(auto, l2l"),
        ({"layout": "vico"}, "no data set that is known here: vico"),
        ({"order": "first"}, r"--order first: expected exp-first or pose-first"),
        ({"split": "tset"}, r"has no split tset \(train, validation\)"),
    ],
)
def test_bad_arguments_are_one_clear_line(change, message, tmp_path):
    composed(tmp_path)
    with pytest.raises(ConfigError, match=message):
        open_dataset(tmp_path, **({"split": "train"} | change))


def test_folder_of_nothing_known_lists_what_is_known(tmp_path):
    with pytest.raises(ConfigError, match=r"no data set that is known here: l2l \(.*composed \("):
        open_dataset(tmp_path, "train")
    with pytest.raises(ConfigError, match="no such folder"):
        open_dataset(tmp_path / "gone", "train")
    (tmp_path / "a.zip").write_bytes(b"PK")
    with pytest.raises(ConfigError, match=r"expected a folder, got a file \(unpack an archive first\)"):
        open_dataset(tmp_path / "a.zip", "train")


def test_a_corpus_leaves_out_what_cannot_be_used_and_says_so(tmp_path, caplog):
    write.react2025(tmp_path, lengths=(30, 60, 75))
    file = tmp_path / "data/train/coefficients/listener/session2/take_2.npy"
    values = np.load(file)
    values[5] = np.nan
    np.save(file, values)
    corpus = gather(open_dataset(tmp_path, "train"), 48, MotionSpace("faceverse58", rest_of("faceverse58")))
    assert corpus.lengths == (60,)
    assert "1 of 3 clips cannot be used" in caplog.text and "1 of 3 dyads are used" in caplog.text
