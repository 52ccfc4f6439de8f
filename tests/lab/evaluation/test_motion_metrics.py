"""`sfms-robot evaluate metrics`: anybody's motion, from files, by the metrics that have tests of their own."""

from pathlib import Path

import numpy as np
import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_S
from sfms_robot.lab.evaluation.motion_metrics import evaluate_metrics
from sfms_robot.signals.tracks import Track, write_track

N, K, T = 3, 2, 80


def motion(seed: int, *shape: int) -> np.ndarray:
    return np.clip(0.3 + np.random.default_rng(seed).normal(0, 0.02, shape).cumsum(-2), 0, 1)


@pytest.fixture
def arrays(tmp_path: Path) -> dict[str, Path]:
    for name, clips in {"truth": motion(1, N, T, 58), "speaker": motion(2, N, T, 58)}.items():
        np.save(tmp_path / f"{name}.npy", clips)
    np.save(tmp_path / "prediction.npy", motion(3, N, K, T, 58))
    return {name: tmp_path / f"{name}.npy" for name in ("truth", "prediction", "speaker")}


def values(result: dict, part: str) -> dict[str, float]:
    return {f"{row['name']}: {row['definition']}": row["value"] for row in result["rows"] if row["part"] == part}


def test_truth_beside_itself_is_without_distance_and_moves_as_often(arrays: dict[str, Path]) -> None:
    result = evaluate_metrics(**arrays | {"prediction": arrays["truth"]})
    for part in ("expression", "rotation"):
        found = values(result, part)
        for name in ("L2: distance over channels", "FD: of all frames", "P-FD: of all frames", "RPCC: flattened"):
            assert found[name] == pytest.approx(0.0, abs=1e-6), name
    counts = values(result, "all")
    assert counts["blinks a minute: prediction"] == counts["blinks a minute: truth"]


def test_folders_of_tracks_go_by_name_and_are_cut_alike(tmp_path: Path) -> None:
    for folder, frames in (("truth", 90), ("ours", 70)):
        (tmp_path / folder).mkdir()
        for seed, name in enumerate(("a.csv", "b.csv.gz")):
            clip = motion(seed, frames, 58).astype(np.float32)
            write_track(tmp_path / folder / name, Track(FRAME_S * np.arange(frames), clip, frozenset(CHANNELS)))
    result = evaluate_metrics(truth=tmp_path / "truth", prediction=tmp_path / "ours", frames=30)
    assert (result["clips"], result["frames"]) == (4, 30)
    assert values(result, "expression")["L2: distance over channels"] == pytest.approx(0.0, abs=1e-4)
    (tmp_path / "ours" / "b.csv.gz").unlink()
    with pytest.raises(ConfigError, match=r"its clips \(a\) are not those of .*truth \(a, b\)"):
        evaluate_metrics(truth=tmp_path / "truth", prediction=tmp_path / "ours")


def test_attributes_of_the_challenge_have_its_own_distances(tmp_path: Path) -> None:
    np.save(tmp_path / "truth.npy", motion(1, N, T, 25))
    np.save(tmp_path / "ours.npy", motion(2, N, K, T, 25))
    result = evaluate_metrics(truth=tmp_path / "truth.npy", prediction=tmp_path / "ours.npy")
    found = values(result, "all")
    assert result["space"] == "attributes25"
    assert found["FRDist: sum of the answers"] == pytest.approx(K * found["FRDist: mean of the answers"])


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((N, T, 57), "57 channels, not 58 .arkit58., 58 .faceverse58., 56 .deca56., 25 .attributes25."),
        ((T,), r"shape \(80,\), not \(T, D\), \(N, T, D\) or \(N, K, T, D\)"),
        ((N, K, T, 58), "only a prediction has several answers"),
    ],
)
def test_an_array_that_cannot_be_scored_is_refused_by_name(tmp_path: Path, shape: tuple, said: str) -> None:
    np.save(tmp_path / "truth.npy", np.zeros(shape))
    np.save(tmp_path / "ours.npy", motion(1, shape[0], T, 58) if len(shape) == 4 else np.zeros(shape))
    with pytest.raises(ConfigError, match=said):
        evaluate_metrics(truth=tmp_path / "truth.npy", prediction=tmp_path / "ours.npy")


def test_a_lost_face_and_too_long_a_cut_are_refused(arrays: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--frames 81: the shortest clip has 80"):
        evaluate_metrics(arrays["truth"], arrays["prediction"], frames=T + 1)
    broken = np.load(arrays["truth"])
    broken[1, 5] = np.nan
    np.save(tmp_path / "lost.npy", broken)
    with pytest.raises(ConfigError, match=r"lost\.npy: clip 1 has values that are not finite"):
        evaluate_metrics(tmp_path / "lost.npy", arrays["prediction"])
