"""The dyad itself: shapes, sound in its three forms, and the way to disk and back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_dyads import made_dyad

from sfms_robot.errors import ConfigError
from sfms_robot.frames import ListenerEvent
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.clips import WIDTHS, Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset
from sfms_robot.signals import mel

RNG = np.random.default_rng(0)


def dyad(frames: int = 20, space: str = "arkit58", fps: float = 25.0, **more) -> Dyad:
    motion = RNG.uniform(0, 0.5, (frames, WIDTHS[space])).astype(np.float32)
    return made_dyad(motion, speaker=motion[::-1].copy(), space=space, fps=fps, **more)


@pytest.mark.parametrize("space", WIDTHS)
@pytest.mark.parametrize("fps", [25.0, 30.0])
def test_what_is_saved_is_read_back(tmp_path, space, fps):
    events = ListenerEvent("nod", 0.1, 0.8, 0.09, 2), ListenerEvent("gaze_shift", 0.2, 0.4, 0.3, target_rad=(-0.3, 0.1))
    made = dyad(
        space=space,
        fps=fps,
        features={"hubert": RNG.normal(size=(20, 5)).astype(np.float32)},
        events=events,
        head_of_gaze_rad=np.full((20, 3), 0.25, np.float32),
        attention=np.array([1, 0, np.nan, *[1] * 17], np.float32),
    )
    clips.save(tmp_path, [made])
    read = clips.read(tmp_path / f"{made.name}.npz")
    assert (read.name, read.space, read.fps, read.events) == (made.name, made.space, made.fps, events)
    np.testing.assert_allclose(read.audio, made.audio, atol=1e-4)
    np.testing.assert_allclose(read.listener, made.listener, atol=1e-3 if space == "arkit58" else 0)
    for name in ("head_of_gaze_rad", "attention"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    np.testing.assert_array_equal(read.features["hubert"], made.features["hubert"])


def test_dyads_of_before_are_still_read(tmp_path):
    """Keys of files that `data compose` wrote when there was one space and one rate."""
    np.savez(tmp_path / "old.npz", audio=np.zeros(1280, np.int16), speaker=np.zeros((2, 58), np.float16),
             listener=np.zeros((2, 58), np.float16), listening=np.ones(2, bool))  # fmt: skip
    read = clips.read(tmp_path / "old.npz")
    assert (read.space, read.fps, read.mel, dict(read.features)) == ("arkit58", 25.0, None, {})
    assert (read.events, read.head_of_gaze_rad, read.attention) == (None, None, None)


def test_a_dyad_without_sound_survives_the_disk(tmp_path):
    clips.save(tmp_path, [dyad(audio=None)])
    read = clips.read(tmp_path / f"{dyad().name}.npz")
    assert read.audio is None and read.mel_rows() is None


@given(st.integers(1, 40), st.sampled_from([24.0, 25.0, 29.97, 30.0, 50.0, 60.0]))
def test_mel_rows_are_four_a_frame_at_any_rate(frames: int, fps: float):
    one = dyad(frames, fps=fps)
    rows = one.mel_rows()
    assert rows is not None and rows.shape == (4 * frames, 128)
    if fps == 25:
        np.testing.assert_array_equal(rows, mel.log_mel(one.audio, mel.start())[0])


def test_mel_rows_at_other_rates_know_no_future():
    one = dyad(60, fps=30.0)
    changed = one.audio.copy()
    changed[16_000:] = 0  # from frame 30 on
    rows, other = one.mel_rows(), replace(one, audio=changed).mel_rows()
    np.testing.assert_array_equal(rows[:120], other[:120])
    assert (rows[124:] != other[124:]).any(axis=1).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"space": "smiles"}, r"motion space 'smiles' is not known \(arkit58"),
        ({"space": "deca56"}, r"speaker has shape \(20, 58\), expected \(20, 56\)"),
        ({"fps": 30.0}, r"audio has shape \(12800,\), expected \(10667,\)"),
        ({"fps": 0.0}, "fps 0 must be above 0"),
        ({"mel": np.zeros((20, 128), np.float32)}, r"mel has shape \(20, 128\), expected \(80, 128\)"),
        ({"features": {"x": np.zeros((19, 3), np.float32)}}, r"feature x has shape \(19, 3\)"),
        ({"listener": np.full((20, 58), np.nan, np.float32)}, "listener must be finite"),
        ({"listening": np.ones(3, bool)}, r"listening has shape \(3,\)"),
    ],
)
def test_a_dyad_that_does_not_fit_together_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(dyad(), **change)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04broken", b"not a zip at all"])
def test_broken_file_is_one_clear_line(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(ConfigError, match="x.npz: not a dyad"):
        clips.read(tmp_path / "x.npz")


def lazy(*dyads: Dyad | Exception) -> tuple[Dataset, list[int]]:
    """A set that notes what is read."""
    read: list[int] = []

    def clip(index: int, one: Dyad | Exception) -> Clip:
        def reader() -> Dyad:
            read.append(index)
            if isinstance(one, Exception):
                raise one
            return one

        return Clip(name=f"clip{index}", frames=20, row=index, read=reader)

    return Dataset(
        layout="l2l", split="train", space="arkit58", fps=25.0, clips=tuple(clip(i, one) for i, one in enumerate(dyads))
    ), read


def test_nothing_is_read_before_it_is_asked_for_and_mistakes_of_ours_are_no_broken_files():
    dataset, read = lazy(dyad(), dyad(), dyad())
    part = dataset.map(lambda one: replace(one, name="b"))[1:]
    assert read == [] and dataset.lengths == (20, 20, 20) and dataset.minutes == pytest.approx(60 / 25 / 60)
    assert part[0].name == "b" and read == [1]
    dataset, _ = lazy(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        dataset[0]


@pytest.mark.parametrize(
    "error", [OSError("gone"), KeyError("exp"), ValueError("odd"), ClipError("unreadable", "x", "y"), EOFError()]
)
def test_any_way_of_breaking_is_a_named_problem(error):
    dataset, _ = lazy(dyad(), error)
    with pytest.raises(ClipError) as found:
        dataset[1]
    assert found.value.problem.kind == "unreadable"
