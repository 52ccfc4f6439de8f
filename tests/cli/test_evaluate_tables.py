"""`sfms-robot evaluate tokenizer --table`: trained from nothing, kept, scored on any folder; what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest

from sfms_robot.app.evaluate.tokenizer_evaluation import TableOptions, train_missing
from sfms_robot.cli.main import main
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_S
from sfms_robot.signals.tracks import Track, write_track

TABLE = ("evaluate", "tokenizer", "--table")


def command(*arguments: object) -> int:
    """Exit code."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stopped:
        return int(stopped.code or 0)
    return 0


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    """A folder with one plain and one gzipped face track, a face that is lost for a while, and a short track."""
    folder = tmp_path / "faces"
    (folder / "deeper").mkdir(parents=True)
    drawn = np.random.default_rng(1)
    for name, frames in (("a.csv", 120), ("deeper/b.csv.gz", 110)):
        motion = np.clip(0.3 + drawn.normal(0, 0.02, (frames, 58)).cumsum(0), 0, 1).astype(np.float32)
        motion[50:52] = np.nan
        write_track(folder / name, Track(FRAME_S * np.arange(frames), motion, frozenset(CHANNELS)))
    short = Track(FRAME_S * np.arange(20), np.zeros((20, 58), np.float32), frozenset(CHANNELS))
    write_track(folder / "short.csv", short)
    return folder


@pytest.mark.slow
def test_a_table_trains_what_is_missing_keeps_it_and_scores_any_folder(
    tmp_path: Path, tracks: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    options = (*TABLE, "4", "--models", tmp_path / "m", "--data", tracks, "--json")
    assert command(*options, "--train", "--steps", 2, "--plots", tmp_path / "p") == 0
    first = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert "1 of 5 stretches with a face are shorter than a window of 48 frames and left out: short.csv" in caplog.text
    assert first["table"] == 4 and first["windows"] == 4
    assert [row["name"] for row in first["rows"]][-1] == "Sparse-FSQ-256"
    for row in first["rows"]:
        assert row["mse"] > 0 and row["bits_per_window"] > 0 and row["params"] > 0
        assert set(row["per_take"]) == {"a.csv", "deeper/b.csv.gz"}
    assert {file.name for file in (tmp_path / "p").iterdir()} == {"keyframes.png", "quantiles.png"}
    assert command(*options) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == first, "nothing is trained a second time"


def test_an_unknown_table_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert command(*TABLE, "5") == 2
    assert "--table '5' is not one of 3, 4, all" in capsys.readouterr().err


def test_an_installed_package_says_how_to_get_the_tokenizers_it_does_not_carry(tmp_path: Path) -> None:
    said = r"2 tokenizers of this table are not there \(a, ...\): add --models DIR, which trains what is missing"
    with pytest.raises(ConfigError, match=said):
        train_missing(TableOptions("4"), ["a", "b"], tmp_path / "tokenizers", {})


def test_training_needs_a_folder_of_ones_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert command(*TABLE, "3", "--train") == 2
    assert "--train needs --models DIR" in capsys.readouterr().err


def test_a_folder_without_tracks_is_refused_before_anything_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(*TABLE, "4", "--data", tmp_path, "--models", tmp_path / "m") == 2
    assert "no face tracks (*.csv, *.csv.gz) below it" in capsys.readouterr().err
    assert not (tmp_path / "m").exists()


def test_without_a_table_dyads_are_needed(capsys: pytest.CaptureFixture[str]) -> None:
    assert command("evaluate", "tokenizer") == 2
    assert "--data is needed without --table" in capsys.readouterr().err
