"""The sway of a head, and the idle motion of a face: sizes, rest, and that they repeat themselves exactly."""

import numpy as np
import pytest
from people_rad import PEOPLE_RAD
from safetensors.numpy import save_file
from tiny_sfms import plans_of, speech, told_listener

from sfms_robot.config import Calmness
from sfms_robot.data import data_dir
from sfms_robot.errors import ModelError
from sfms_robot.frames import BLENDSHAPES, EVENT_KINDS, FRAME_S, MOTION_DIM, SHAPES, changed
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.eventful import EventfulListener
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.listeners.idle import (
    AFTER_SPEECH_S,
    BANDS,
    BANDS_HZ,
    EASE_S,
    IDLE_BANDS,
    IDLE_BANDS_HZ,
    KNOTS,
    LINES,
    UNEVEN,
    WIDEST,
    HeadSway,
    IdleMotion,
    RestMap,
    draw_sway,
    head_channels,
    sway_at,
)
from sfms_robot.listeners.space import MotionSpace


def made_sway(seed: int = 0, amplitude: float = 0.01, spread: float = 0.0) -> np.ndarray:
    return draw_sway(np.tile(amplitude * np.eye(6, dtype=np.float32), (BANDS, 1, 1)), spread, seed)


def powers(sway: np.ndarray) -> np.ndarray:
    """(BANDS, S, S) what the channels of a stream (3, 1 + L, S) do together in each band, in the long run."""
    _, size, phase = sway[:, 1:].reshape(3, BANDS, LINES, -1)
    line = size * np.exp(1j * phase)
    return np.einsum("bls,blt->bst", line, line.conj()).real / 2


def test_every_stream_has_the_powers_that_were_learned_and_a_manner_within_what_peoples_is():
    mixture = np.random.default_rng(0).normal(0, 0.01, (BANDS, 6, 6)).astype(np.float32)
    learned = mixture.astype(np.float64) @ mixture.transpose(0, 2, 1)
    for seed in range(20):
        np.testing.assert_allclose(powers(draw_sway(mixture, 0.0, seed)), learned, rtol=1e-6, atol=1e-9)
    manners = []
    for seed in range(300):
        ratio = powers(draw_sway(mixture, 0.3, seed)) / learned
        assert np.ptp(ratio) < 1e-3 * ratio.mean()  # the same in every band and channel
        manners.append(np.log(ratio.mean()) / 2)
    assert float(np.std(manners)) == pytest.approx(0.3, rel=0.15)
    assert np.abs(manners).max() == pytest.approx(0.3 * WIDEST, rel=1e-3)  # some of 300 would be beyond


def test_a_head_stands_and_shifts_and_its_turns_and_its_shifts_at_other_times():
    """Of two seconds: how far it goes in a tenth of them is far less than in most; no clock ever goes back."""
    slow = np.linspace(0.01, 0, BANDS, dtype=np.float32) ** 2
    sways = [draw_sway(slow[:, None, None] * np.eye(2, dtype="f4"), 0.0, seed, shifting=[1]) for seed in range(30)]
    moved = [sway_at(one, 10 + np.arange(2000) * 0.04).reshape(40, 50, 2).std(1) for one in sways]
    low, median = np.percentile(np.concatenate(moved), [10, 50], axis=0)
    assert (low < 0.4 * median).all()
    assert abs(np.corrcoef(np.log(np.concatenate(moved)).T)[0, 1]) < 0.15
    for one in sways:
        pace, off_s, _ = one[:, 0]
        assert (pace * off_s < 1).all() and pace[0] != pace[1]


def test_channels_go_together_as_they_are_mixed_and_every_other_stream_is_mirrored():
    times_s = 10 + np.arange(3000) * 0.2
    mixture = np.tile(np.array([[0.01, 0.0], [-0.009, 0.004]], np.float32), (BANDS, 1, 1))
    r = [np.corrcoef(sway_at(draw_sway(mixture, 0.0, seed), times_s).T)[0, 1] for seed in range(30)]
    assert np.mean(r) == pytest.approx(-0.91, abs=0.05) and max(r) < -0.6
    r = [np.corrcoef(sway_at(draw_sway(mixture, 0.0, seed, [1]), times_s).T)[0, 1] for seed in range(30)]
    assert np.mean(np.abs(r)) == pytest.approx(0.91, abs=0.05) and min(r) < -0.6 and max(r) > 0.6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sfms-small", "arig-small"])
def test_the_heads_of_shipped_listeners_sway_as_far_as_people_do(name: str):
    """Ten minutes of 60 streams: some sway further than most people, all together they do not."""
    folder = data_dir("configs") / "listeners" / name
    settings = checkpoint.load_config(folder)
    space = MotionSpace.of(settings)
    sway = HeadSway(settings, checkpoint.read_weights(folder / checkpoint.WEIGHTS))
    low, high = np.array(PEOPLE_RAD).T
    outside, alive = [], []
    for seed in range(60):
        motion = np.tile(space.neutral.astype(np.float32), (1490, 1))
        motion[:, head_channels(settings.channels)] += sway_at(sway.start(seed), 4.04 + 0.4 * np.arange(1490))
        pose = space.decode(motion)[0][:, :3]
        outside.append(((pose < low) | (pose > high)).mean(0))
        alive.append(pose.std(0))
    assert np.mean(outside, axis=0).max() < 0.05
    assert np.max(outside) < 0.2  # of the one in 60 who sways most
    assert (np.array(alive) > 0.2 * (high - low) / 4.65).all()


BROW = BLENDSHAPES.index("browInnerUp")


def made(size=0.02, spread=0.0, rest=0.0):
    loadings = np.zeros((2, len(BLENDSHAPES)), np.float32)
    loadings[0, BROW], loadings[1, BROW + 1] = size, size
    amplitude = np.full((IDLE_BANDS, 2), IDLE_BANDS**-0.5, np.float32)
    held = np.tile(np.linspace(0.4, 0.6, KNOTS, dtype=np.float32)[:, None], len(BLENDSHAPES))
    return IdleMotion(loadings, amplitude, spread, held, held + np.float32(rest))


def test_where_it_rests_is_added_once_it_has_set_in_but_not_to_a_mouth_that_speaks():
    stream = made(size=0.0, rest=-0.1).start(1)
    shown = stream.added(faces(3), np.array([0.0, EASE_S, 60.0]))[:, SHAPES]
    np.testing.assert_allclose(shown, np.array([0.5, 0.4, 0.4])[:, None] * np.ones((3, 52)), atol=1e-6)
    assert not stream.added(faces(1, 0.05), np.array([60.0]))[:, SHAPES].any()
    stream, silent_s = made(size=0.0, rest=-0.1).start(1), AFTER_SPEECH_S * np.array([0.0, 1.0, 1.5, 2.0, np.inf])
    shown = stream.added(faces(5), np.full(5, 60.0), silent_s)[:, SHAPES]
    np.testing.assert_allclose(shown[:, BLENDSHAPES.index("jawOpen")], [0.5, 0.5, 0.45, 0.4, 0.4], atol=1e-6)
    np.testing.assert_allclose(shown[:, BROW], 0.4, atol=1e-6)


def test_a_map_takes_quantiles_to_quantiles_never_falls_and_moves_a_channel_that_never_varies_no_more():
    rng = np.random.default_rng(0)
    held, shown = np.sort(rng.uniform(0.2, 0.4, (2, KNOTS, len(BLENDSHAPES))), axis=1).astype(np.float32)
    rest = RestMap.between(held, shown)
    np.testing.assert_allclose(held + rest.off(held), shown, atol=1e-6)
    grid = np.repeat(np.linspace(0, 1, 200, dtype=np.float32)[:, None], len(BLENDSHAPES), axis=1)
    assert np.diff(grid + rest.off(grid), axis=0).min() > -1e-6
    np.testing.assert_allclose(rest.off(grid)[[0, -1]], np.stack([shown[0] - held[0], shown[-1] - held[-1]]), atol=1e-6)
    held = np.full((KNOTS, len(BLENDSHAPES)), 0.3, np.float32)
    np.testing.assert_allclose(RestMap.between(held, held - 0.1).off(faces(3)[:, SHAPES]), -0.1, atol=1e-6)


def faces(frames, level=0.5):
    return np.full((frames, MOTION_DIM), level, np.float32)


def test_faces_stay_faces():
    for level in (0.0, 1.0):
        out = made(0.4).start(0).added(faces(500, level), np.arange(500) * 0.04)
        assert out[:, SHAPES].min() >= 0 and out[:, SHAPES].max() <= 1 and out[:, SHAPES].std() > 0.01


def test_what_is_saved_is_loaded(tmp_path):
    made(spread=0.2).save(tmp_path / "a.safetensors")
    found = IdleMotion.load(tmp_path / "a.safetensors")
    np.testing.assert_array_equal(found.loadings, made().loadings)
    np.testing.assert_array_equal([found.held, found.shown], [made().held, made().shown])
    assert found.spread == pytest.approx(0.2)


FLAT = np.zeros((KNOTS, len(BLENDSHAPES)), np.float32)
RISING = np.repeat(np.linspace(0, 1, KNOTS, dtype=np.float32)[:, None], len(BLENDSHAPES), axis=1)
BROKEN = {
    "expected tensors": {"spread": None},
    "not finite": {"loadings": np.full((2, 52), np.nan, np.float32)},
    "got .*\\(2, 51\\)": {"loadings": np.zeros((2, 51), np.float32)},
    "got .*\\(9, 51\\)": {"held": FLAT[:, :51]},
    "shown": {"shown": FLAT[1:]},
    "falls": {"held": -RISING},
    "steeper": {"held": 0.1 * RISING, "shown": 0.3 * RISING},
    "got 0.6": {"shown": FLAT - 0.6},
    "amplitude": {"amplitude": np.zeros((IDLE_BANDS, 3), np.float32)},
    "expected motion up to": {"loadings": np.ones((2, 52), np.float32)},
    "and 7": {"spread": np.float32([7.0])},
}


@pytest.mark.parametrize("problem", BROKEN)
def test_a_broken_file_is_one_line(tmp_path, problem):
    file, good = tmp_path / "a.safetensors", made()
    tensors = {"loadings": good.loadings, "amplitude": good.amplitude, "spread": np.float32([0.0])}
    tensors |= {"held": FLAT, "shown": FLAT} | BROKEN[problem]
    save_file({name: np.ascontiguousarray(value) for name, value in tensors.items() if value is not None}, file)
    with pytest.raises(ModelError, match=problem) as raised:
        IdleMotion.load(file)
    assert str(file) in str(raised.value) and "\n" not in str(raised.value)


def planned(hop, idle, said=range(0)):
    """What a listener with this idle motion plans, which speaks itself in these frames."""
    nothing = Calmness(**dict.fromkeys(EVENT_KINDS, 0.0))
    listener = EventfulListener(told_listener(hop=hop), EventModel.load(), nothing, idle)
    speaker = [changed(frame, agent_audio=frame.audio if at in said else None) for at, frame in enumerate(speech(120))]
    return plans_of(listener, speaker, seed=5).values()


@pytest.mark.parametrize("hop", [2, 4])
def test_a_listener_adds_it_to_every_plan_whatever_the_hop_and_tells_it_of_its_own_voice(hop):
    for still, moving in zip(planned(hop, None), planned(hop, made(0.01)), strict=True):
        expected = made(0.01).start(5).added(still.frames, still.times_s)
        np.testing.assert_allclose(moving.frames, expected, atol=1e-6)
    idle, said = made(0.01, rest=0.02), range(40, 70)
    for still, moving in zip(planned(hop, None, said), planned(hop, idle, said), strict=True):
        newest = round(still.times_s[0] / FRAME_S) - 2
        before = [index for index in said if index <= newest]
        silent_s = (newest - before[-1]) * FRAME_S + still.times_s - still.times_s[0] if before else np.inf
        expected = idle.start(5).added(still.frames, still.times_s, silent_s)
        np.testing.assert_allclose(moving.frames, expected, atol=1e-6)


def of_sway(seed, times_s, spread=0.0):
    return sway_at(made_sway(seed, spread=spread), times_s).astype(np.float64)


def of_idle(seed, times_s, spread=0.0):
    moved = made(spread=spread).start(seed).added(faces(len(times_s)), times_s).astype(np.float64) - 0.5
    assert not moved[:, : SHAPES.start].any()  # the head is left alone
    return moved[:, SHAPES][:, [BROW, BROW + 1]]


BOTH = pytest.mark.parametrize(
    ("motion", "size", "fastest_hz"),
    [(of_sway, 0.01 * BANDS**0.5, (1 + UNEVEN) * BANDS_HZ[-1]), (of_idle, 0.02, IDLE_BANDS_HZ[-1] + 0.05)],
    ids=["sway", "idle"],
)


@BOTH
@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_piece_by_piece_it_is_the_whole(motion, size, fastest_hz, chunk):
    times_s = (np.arange(400) + 1) * 0.04
    parts = [motion(3, some) for some in np.split(times_s, range(chunk, 400, chunk))]
    np.testing.assert_allclose(np.concatenate(parts), motion(3, times_s), atol=1e-6)


@BOTH
def test_it_sets_in_from_rest_no_faster_than_its_bands_and_each_stream_goes_its_own_way(motion, size, fastest_hz):
    out = np.abs(motion(1, np.array([-1.0, 0.0, EASE_S / 100, EASE_S, 60.0]))).max(1)
    assert not out[:2].any() and out[2] < 1e-4 < out[3:].max()
    moved = motion(2, 10 + np.arange(5000) * 0.04)
    power, hz = np.square(np.abs(np.fft.rfft(moved - moved.mean(0), axis=0))).sum(1), np.fft.rfftfreq(5000, 0.04)
    assert power[hz > fastest_hz].sum() < 0.01 * power.sum()
    times_s = 10 + np.arange(3000) * 0.2
    together = np.corrcoef(np.concatenate([motion(1, times_s), motion(2, times_s)], axis=1).T)
    assert np.abs(together - np.eye(len(together))).max() < 0.4


@BOTH
def test_its_size_is_what_was_asked_also_after_an_hour_and_people_differ_by_the_spread(motion, size, fastest_hz):
    for since_s in (10.0, 3600.0):
        found = [motion(seed, since_s + np.arange(40) * 2.3) for seed in range(150)]
        assert float(np.std(found)) == pytest.approx(size, rel=0.05)
    sizes = [np.log(motion(seed, 10 + np.arange(300) * 1.7, spread=0.5).std()) for seed in range(60)]
    assert 0.3 < float(np.std(sizes)) < 0.65
