"""Tables of tokenizers: takes, folders, scores, rows, what they need and what they say."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot import config
from sfms_robot.config import parse
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError, ModelError
from sfms_robot.lab.corpora.clips import read_takes
from sfms_robot.lab.evaluation import tokenizer_tables
from sfms_robot.lab.evaluation.table_tokenizers import TableModel, keyframe_bits, load_tokenizer, save_tokenizer
from sfms_robot.lab.evaluation.table_training import load_history, train
from sfms_robot.lab.evaluation.tokenizer_tables import Windows, cluster, integrity, restoration_errors
from sfms_robot.lab.learning.corpus import first_frames
from sfms_robot.lab.learning.job import Run
from sfms_robot.lab.learning.sfms.tokenizer_trainer import amplified
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.placement import place_exact
from sfms_robot.signals.tracks import Take

TRAINING = {"steps": 3, "batch": 2, "learning_rate": 1e-3, "evaluate_every": 0, "score_tracks": 4}


def sparse(placement: str = "static", preset: str = "four", k: int = 3) -> config.Recipe:
    listener = {
        "kind": "sfms",
        "placement": placement,
        "groups": {"preset": preset, "levels": [4, 4], "keyframes": k},
        "tokenizer_width": 16,
        "scores": {"width": 8},
    }
    return parse(config.Recipe, {"model": listener, "training": TRAINING}, "sparse")


def dense(**more: object) -> config.Recipe:
    raw = {"kind": "dense", "quantizer": "fsq", "levels": [4, 4], "width": 16, "layers": 1, **more}
    return parse(config.Recipe, {"model": raw, "training": TRAINING}, "dense")


def grouped(**more: object) -> config.Recipe:
    return dense(**{"kind": "grouped", "quantizer": "vq", "levels": [32]} | more)


def faces(frames: int = 200, seed: int = 1) -> list[Take]:
    steps = np.random.default_rng(seed).normal(0, 0.02, (frames, 58)).cumsum(axis=0)
    return [Take("walk", np.clip(0.3 + steps, 0, 1).astype(np.float32))]


def mse_of(model: TableModel, seen: Windows) -> float:
    motion = model.standardise(seen.motion)
    return float(restoration_errors(model, motion, model.restore(motion))[0].mean())


def test_the_bundled_takes_hold_out_what_they_say() -> None:
    found = read_takes(data_dir("sim") / "listeners" / "takes.npz")
    held_out, trained = ({take.name for take in found[split]} for split in ("held_out", "train"))
    assert held_out == {"apfel", "d12", "d18", "alex_rom_4"}
    assert held_out & trained == {"alex_rom_4"}, "its first half is learned from, its second is not"
    assert sum(len(take.motion) for take in found["train"]) > 9_000


def test_a_broken_file_of_takes_or_history_is_named(tmp_path: Path) -> None:
    (tmp_path / "t.npz").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match=r"t\.npz: not a file of recorded takes"):
        read_takes(tmp_path / "t.npz")
    assert load_history(tmp_path) == []
    (tmp_path / "history.json").write_text('[{"stride": 1}]')
    with pytest.raises(ModelError, match=r"history\.json: not the history of a tokenizer"):
        load_history(tmp_path)


def test_windows_lie_in_one_take_do_not_overlap_and_need_one_that_is_long_enough() -> None:
    motion = faces(130)[0].motion
    seen = Windows.of([Take("a", motion[:100]), Take("short", motion[:20]), Take("b", motion[80:])], 48)
    assert seen.takes == ("a", "a", "b")
    np.testing.assert_array_equal(seen.motion[1].numpy(), motion[48:96])
    np.testing.assert_array_equal(seen.motion[2].numpy(), motion[80:128])
    with pytest.raises(ConfigError, match="none of 1 stretches .* as long as a window of 48 frames"):
        Windows.of([Take("a", faces(40)[0].motion)], 48)
    assert first_frames([10, 50, 49], 48).tolist() == [10, 11, 12, 60, 61] and first_frames([10], 48).tolist() == []


@pytest.mark.parametrize(
    "recipe",
    [sparse(), sparse("learned"), sparse("learned_paper"), sparse("adaptive"), dense(), grouped()],
    ids=lambda r: r.model.kind,
)
def test_any_recipe_trains_is_kept_and_scores_the_same_again(recipe: config.Recipe, tmp_path: Path) -> None:
    seen = Windows.of(faces(seed=2), 48)
    train("one", recipe, faces(), tmp_path, Run(), seen.motion[:1])
    assert not list((tmp_path / "one").glob("checkpoint-*")), "a finished tokenizer needs no checkpoint"
    read = load_tokenizer(tmp_path / "one")
    assert read.recipe == recipe
    save_tokenizer(tmp_path / "again", read)
    assert mse_of(load_tokenizer(tmp_path / "again"), seen) == mse_of(read, seen)


def test_weights_of_another_recipe_are_refused(tmp_path: Path) -> None:
    save_tokenizer(tmp_path / "a", TableModel(sparse()))
    save_tokenizer(tmp_path / "b", TableModel(dense()))
    (tmp_path / "a" / checkpoint.WEIGHTS).replace(tmp_path / "b" / checkpoint.WEIGHTS)
    with pytest.raises(ModelError, match="the weights belong to another configuration"):
        load_tokenizer(tmp_path / "b")


def test_places_cost_bits_only_where_nobody_expects_them() -> None:
    static, learned = TableModel(sparse("static")), TableModel(sparse("learned"))
    codes = 4 * 3 * np.log2(16)
    assert static.bits() == static.bits("static_paper") == pytest.approx(codes)
    assert learned.bits() == static.bits("exact") == pytest.approx(codes + 4 * np.log2(48 * 47 * 46 / 6))
    assert TableModel(sparse("learned", k=4)).bits() > learned.bits()


def test_scores_are_in_deviations_of_the_training_motion_and_count_every_channel_the_same() -> None:
    one, motion = TableModel(dense()), torch.from_numpy(faces()[0].motion)
    one.fit_scales(motion)
    found = one.standardise(motion)
    assert float(found.mean()) == pytest.approx(0, abs=1e-4)
    assert float(found.std(0).mean()) == pytest.approx(1, abs=0.01)
    one.fit_scales(torch.zeros(50, 58))
    assert float(one.motion_std.min()) == pytest.approx(0.005), "a still channel is not blown up"
    wrong = torch.zeros(2, 48, 58)
    wrong[0, :, 0], wrong[1, :, 57] = 1.0, 2.0
    errors, angle_rmse_rad, shape_rmse = restoration_errors(TableModel(dense()), torch.zeros_like(wrong), wrong)
    assert errors == pytest.approx([1 / 58, 4 / 58])
    assert angle_rmse_rad == pytest.approx(np.sqrt(0.5 / 3)) and shape_rmse == pytest.approx(np.sqrt(2 / 52))


def test_a_dense_window_pays_for_every_frame_and_a_grouped_one_for_every_eight() -> None:
    for recipe, codes, bits in ((dense(levels=[8, 5, 5, 5]), 48, np.log2(1000)), (grouped(), 6, 5)):
        assert TableModel(recipe).bits() == pytest.approx(codes * bits)
    with pytest.raises(ConfigError, match="window_frames 20 is not a multiple of 8"):
        TableModel(grouped(window_frames=20))


def test_without_rounding_a_row_is_restored_from_what_codes_were_chosen_by(tmp_path: Path) -> None:
    train("one", sparse(), faces(), tmp_path, Run())
    model, motion = load_tokenizer(tmp_path / "one"), torch.randn(2, 48, 58)
    coarse, fine = (model.restore(motion, rounded=rounded) for rounded in (True, False))
    assert not torch.equal(coarse, fine) and torch.equal(coarse, model.restore(motion, model.mask(motion)))


def test_keyframes_that_lie_side_by_side_are_counted_and_so_are_scores_that_decide_alone() -> None:
    model, mask = TableModel(sparse("learned_paper", "one", 4)).eval(), torch.zeros(1, 48, 1)
    mask[0, [3, 4, 20, 40]] = 1.0
    with torch.inference_mode():
        model.sparse().score.out.weight.zero_()
        found = tokenizer_tables.placed(model, torch.randn(1, 48, 58), mask)
    assert found["keyframes"] == 4 and found["neighbours"] == 0.5
    assert found["score_deviation"] == 0 and found["draw_overlap"] < 0.6, "the noise alone decides"


def test_three_seeds_on_one_side_decide_what_the_paper_says() -> None:
    def row(name: str, *mse: float) -> dict:
        return {"name": name, "note": "our inpainter", "k": 7, "mse": np.mean(mse), "mse_by_seed": [*mse]}

    even = row("Static, centred", 0.2, 0.2, 0.2)
    for mse, said in (((0.1, 0.1, 0.19), "holds"), ((0.1, 0.1, 0.3), "open"), ((0.3, 0.3, 0.3), "does not hold")):
        (claim,) = tokenizer_tables.claims([row("Algorithm 1", *mse), even])
        assert claim["verdict"] == said and claim["ratio"] == pytest.approx(np.mean(mse) / 0.2, abs=1e-3)
    (claim,) = tokenizer_tables.claims([row("Algorithm 1", 0.1), even])
    assert (claim["seeds"], claim["verdict"]) == (1, "open")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"only": "*k7,no*"}, r"--only \*k7,no\*: expected patterns of tokenizers of this table \(valid: sparse-"),
        ({"seeds": 3}, "--seeds 3: needs --models DIR, where tokenizers of other seeds"),
    ],
)
def test_rows_that_cannot_be_had_are_named(options, said) -> None:
    with pytest.raises(ConfigError, match=said):
        tokenizer_tables.evaluate_table("3-placements", **options)


def test_a_learning_tokenizer_leaves_a_history_of_its_scores(tmp_path: Path) -> None:
    seen = Windows.of(faces(), 48)
    train("one", sparse("learned"), faces(), tmp_path, Run(), seen.motion[:2])
    snapshots = load_history(tmp_path / "one")
    train("one", sparse("learned"), faces(), tmp_path, Run(resume=False), seen.motion[:2])
    assert load_history(tmp_path / "one") == snapshots, "trained again, it begins again"
    assert {snapshot.window for snapshot in snapshots} == {0, 1}
    assert snapshots[0].step == 0 and snapshots[-1].step == 2
    for snapshot in snapshots:
        assert len(snapshot.keyframes) == 3 and len(snapshot.scores) == len(snapshot.errors) == 48
        assert np.exp(snapshot.scores).sum() == pytest.approx(1, abs=0.01)


def test_amplified_windows_keep_their_shape_and_their_best_masks() -> None:
    batch = torch.randn(4, 48, 3, generator=torch.Generator().manual_seed(1))
    louder = amplified(batch, 0.4, torch.Generator().manual_seed(2))
    gain = louder / batch
    assert torch.allclose(gain, gain[:, :1, :1].expand_as(gain), rtol=1e-4)
    assert float(gain.min()) > 0 and float(gain.std()) > 0.05
    member = torch.eye(3)
    assert torch.equal(place_exact(batch, [5] * 3, member), place_exact(louder, [5] * 3, member))


@given(st.integers(1, 60), st.data())
def test_bits_are_the_logarithm_of_how_many_codes_there_are(frames, data):
    k, codes = data.draw(st.integers(0, frames)), data.draw(st.integers(1, 1024))
    assert 2 ** keyframe_bits(frames, k, codes) == pytest.approx(math.comb(frames, k) * codes**k, rel=1e-6)
    with pytest.raises(ValueError, match="keyframes: expected 0 to 8, got 9"):
        keyframe_bits(8, 9, 2)


def kinds(each: int = 5, seed: int = 0) -> np.ndarray:
    """(3 * each, 30, 4): three kinds of motion, each time at another pace and a little different."""
    rng, out = np.random.default_rng(seed), []
    for kind in range(3):
        for _ in range(each):
            phase = np.linspace(0, 2 * np.pi * rng.uniform(0.9, 1.1), 30)[:, None]
            shape = np.sin((kind + 1) * phase + np.arange(4)) * (kind + 1)
            out.append(shape + rng.normal(0, 0.05, (30, 4)))
    return np.stack(out)


def test_kinds_are_found_kept_by_whole_restoration_and_lost_where_codes_pull_them_together():
    _, labels = cluster(kinds(), 3)
    assert [len(set(labels[rows])) for rows in np.split(np.arange(15), 3)] == [1, 1, 1] and len(set(labels)) == 3
    motion = kinds()
    clusters = cluster(motion, 3)
    silhouette, separation = integrity(motion, motion, clusters)
    assert separation == pytest.approx(1) and silhouette > 0.5
    clusters, mean = cluster(motion, 3), motion.mean(0)
    kept, _ = integrity(motion, motion, clusters)
    rng = np.random.default_rng(1)
    silhouette, separation = integrity(
        mean + 0.3 * (motion - mean) + rng.normal(0, 0.3, motion.shape), motion, clusters
    )
    assert separation < 0.7 and silhouette < kept - 0.2
