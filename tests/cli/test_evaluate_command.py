"""`sfms-robot evaluate tokenizer --table`: trained from nothing, kept, scored on any folder."""

from pathlib import Path

import numpy as np
import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_S
from sfms_robot.lab.evaluation.tokenizer_tables import missing_in
from sfms_robot.signals.tracks import Track, write_track


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
    tmp_path: Path, tracks: Path, command_line, caplog: pytest.LogCaptureFixture
) -> None:
    options = ("evaluate", "tokenizer", "--table", "4", "--models", tmp_path / "m", "--data", tracks, "--json")
    trained = command_line(*options, "--train", "--steps", 2, "--plots", tmp_path / "p")
    first = trained.told
    assert trained.code == 0
    assert "1 of 5 stretches with a face are shorter than a window of 48 frames and left out: short.csv" in caplog.text
    assert first["table"] == 4 and first["windows"] == 4
    assert [row["name"] for row in first["rows"]][-1] == "Sparse-FSQ-256"
    for row in first["rows"]:
        assert row["mse"] > 0 and row["bits_per_window"] > 0 and row["params"] > 0
        assert set(row["per_take"]) == {"a.csv", "deeper/b.csv.gz"}
    assert {file.name for file in (tmp_path / "p").iterdir()} == {"keyframes.png", "quantiles.png"}
    again = command_line(*options)
    assert again.code == 0 and again.told == first, "nothing is trained a second time"


def test_an_installed_package_says_how_to_get_the_tokenizers_it_does_not_carry(tmp_path: Path) -> None:
    said = r"2 tokenizers of this table are not there \(a, ...\): add --models DIR, which trains what is missing"
    with pytest.raises(ConfigError, match=said):
        missing_in(tmp_path / "tokenizers", ["a", "b"], may_train=False)
