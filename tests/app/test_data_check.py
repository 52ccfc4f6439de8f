"""`data check` on sets with one thing wrong: it is counted and named, and the rest stays usable."""

import json
from pathlib import Path

import dataset_writers as write
import numpy as np
import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora.data_commands import check_data


def problems(report, split="train"):
    (found,) = [one for one in report["splits"] if one["split"] == split]
    return {one["kind"]: (one["count"], one["names"]) for one in found["problems"]}, found


def broken_npy(file: Path, change) -> None:
    np.save(file, change(np.load(file)))


def with_nan(values):
    values = values.copy()
    values[3, ...] = np.nan
    return values


FACE = "data/train/coefficients/listener/session0/take_0.npy"
VOICE = "data/train/audio/speaker/session0/take_0.wav"
MOOD = "data/train/facial-attributes/listener/session0/take_0.npy"


@pytest.mark.parametrize(
    ("harm", "kind", "where"),
    [
        (lambda root: (root / FACE).unlink(), "missing half", "listener/session0/take_0.npy"),
        (lambda root: (root / FACE.replace("listener", "speaker")).unlink(), "missing half", "speaker/session0/take_0"),
        (lambda root: (root / FACE).write_bytes(b"junk"), "unreadable", "listener/session0/take_0.npy"),
        (lambda root: broken_npy(root / FACE, lambda x: x[..., :50]), "wrong dims", "listener/session0/take_0.npy"),
        (lambda root: broken_npy(root / FACE, lambda x: x[:20]), "lengths differ", "session0+take_0"),
        (lambda root: broken_npy(root / FACE, with_nan), "not finite", "listener/session0/take_0.npy"),
        (lambda root: (root / VOICE).unlink(), "missing sound", "audio/speaker/session0/take_0.wav"),
        (lambda root: write.wav(root / VOICE, 0.5), "lengths differ", "audio/speaker/session0/take_0.wav"),
        (lambda root: (root / VOICE).write_bytes(b"RIFF"), "unreadable", "session0+take_0"),
        (lambda root: broken_npy(root / MOOD, lambda x: x[:, :20]), "wrong dims", MOOD.removeprefix("data/train/")),
    ],
)
def test_one_harm_is_one_named_problem_and_the_rest_is_usable(tmp_path, harm, kind, where):
    write.react2025(tmp_path)
    harm(tmp_path)
    report = check_data(tmp_path)
    found, split = problems(report)
    assert list(found) == [kind] and found[kind][0] == 1 and where in found[kind][1][0]
    assert report["usable"] and split["clips"] == (2 if "attributes" in where else 1)


def test_speaker_frames_that_are_not_finite_are_unknown_not_a_problem(tmp_path):
    write.react2025(tmp_path)
    broken_npy(tmp_path / FACE.replace("listener", "speaker"), with_nan)
    found, split = problems(check_data(tmp_path))
    assert not found and split["speaker_unknown_frames"] == 1


def test_figures_are_those_of_the_files(tmp_path):
    write.react2025(tmp_path)
    _, split = problems(check_data(tmp_path))
    motion = np.concatenate(
        [np.load(tmp_path / FACE.replace("0/take_0", f"{n}/take_{n}")).squeeze() for n in (0, 1)]
    ).astype(float)
    for channel, values in zip(split["channels"], motion.T, strict=True):
        expected = values.min(), values.max(), values.mean(), values.std()
        np.testing.assert_allclose([channel[key] for key in ("min", "max", "mean", "std")], expected, atol=1e-4)
    assert split["channels"][52]["name"] == "rotation_x"
    assert split["minutes"] == pytest.approx(135 / 30 / 60, abs=1e-3)
    assert split["frames"] == {"min": 60, "median": 67.5, "max": 75} and split["sound"] == {"waveform": 2}
    assert split["features"] == {"attributes": 2, "speaker_attributes": 2, "wav2vec2": 2}


def test_swapped_order_makes_a_set_unusable_until_it_is_said(tmp_path, command_line):
    write.l2l(tmp_path, pose_first=True)
    ended = command_line("data", "check", tmp_path, "--json")
    report = ended.told
    assert ended.code == 2 and not report["usable"]
    assert problems(report, "test")[0]["swapped order"] == (1, ["test"])
    assert check_data(tmp_path, order="pose-first")["usable"]


def test_missing_list_is_said_and_other_splits_are_still_looked_at(tmp_path):
    write.react(tmp_path, frames=60)
    write.react(tmp_path, frames=60, split="train")
    (tmp_path / "train.csv").unlink()
    report = check_data(tmp_path)
    assert "lists which clips belong together" in problems(report)[1]["problems"][0]["first"]
    assert report["usable"] and problems(report, "validation")[1]["clips"] == 4


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "name", ["l2l", "lm_listener", "react", "react2025", "dualtalk", "dualtalk_arkit", "dim", "vico", "seamless"]
)
def test_no_broken_byte_is_more_than_a_problem(tmp_path, name, seed):
    """Files that are cut, emptied, scrambled or swapped with each other: a report or one clear line, never a trace."""
    rng = np.random.default_rng([seed, len(name)])
    short = {"react": {"frames": 30, "pairs": 1}, "l2l": {"train": 2, "test": 1}}.get(name, {})
    getattr(write, name)(tmp_path, **short)
    files = sorted(file for file in tmp_path.rglob("*") if file.is_file())
    for file in rng.choice(np.array(files, object), min(len(files), 4), replace=False):
        content = bytearray(file.read_bytes())
        match int(rng.integers(5)):
            case 0:
                content = content[: int(rng.integers(len(content)))]
            case 1:
                content = bytearray()
            case 2:
                content = bytearray(rng.bytes(500))
            case 3:
                for at in rng.integers(0, min(300, len(content)), 8):
                    content[at] ^= int(rng.integers(1, 256))
            case 4:
                content = bytearray(files[int(rng.integers(len(files)))].read_bytes())
        file.write_bytes(content)
    try:
        report = check_data(tmp_path)
    except ConfigError as error:
        assert "\n" not in str(error)
    else:
        json.dumps(report, allow_nan=False)
