"""On a random model of the real architecture, three hundred times smaller."""

import json

import numpy as np
import pytest

from sfms_robot.errors import MissingExtra, ModelError
from sfms_robot.signals import wav2vec2

NOISE = np.random.default_rng(0).normal(0, 0.1, 16_000).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    transformers = pytest.importorskip("transformers")
    place = tmp_path_factory.mktemp("tiny")
    tiny = transformers.Wav2Vec2Config(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, intermediate_size=32, conv_dim=(8,) * 7,
        num_conv_pos_embeddings=16, num_conv_pos_embedding_groups=2,
    )  # fmt: skip
    transformers.Wav2Vec2Model(tiny).save_pretrained(place)
    (place / "preprocessor_config.json").write_text(json.dumps({"do_normalize": True}))
    return place


@pytest.fixture(scope="module")
def model(folder):
    return wav2vec2.Wav2Vec2(folder)


def rows_of(model, sound, sizes=()):
    """The rows of a stream that comes in pieces of these sizes, and its past."""
    rows, past = [], model.start()
    for piece in np.split(sound, np.cumsum(sizes)):
        new, past = model.step(piece, past)
        assert len(new) % model.hop_frames == 0
        rows.append(new)
    return np.concatenate(rows), past


@pytest.mark.parametrize("hop", [1, 2, 8])
@pytest.mark.parametrize("sizes", [[640] * 25, [100, 5000, 640, 1], [1000] * 16, [16_000]])
def test_rows_do_not_depend_on_how_a_stream_is_cut(folder, hop, sizes):
    model = wav2vec2.Wav2Vec2(folder, hop_frames=hop)
    whole, past = rows_of(model, NOISE)
    assert whole.shape == (25 // hop * hop, 16)
    rows, left = rows_of(model, NOISE, sizes)
    np.testing.assert_allclose(rows, whole, atol=1e-4)
    np.testing.assert_array_equal(left, past)
    assert len(past) == len(model.start()) + 640 * (25 % hop) and not model.start().any()


def test_rows_of_a_hop_come_in_order(folder, model):
    (rows, _), (longer, _) = (rows_of(each, NOISE) for each in (model, wav2vec2.Wav2Vec2(folder, hop_frames=8)))
    assert np.abs(longer - rows[:24]).mean() < 0.7 * np.abs(longer - rows[1:]).mean()


def test_rows_forget_2_s_ago_and_do_not_depend_on_loudness(model):
    long = np.concatenate([NOISE, NOISE, NOISE, NOISE])
    np.testing.assert_allclose(rows_of(model, long)[0][60:75], rows_of(model, long[640 * 9 :])[0][51:66], atol=1e-4)
    np.testing.assert_allclose(rows_of(model, NOISE)[0][-1], rows_of(model, 0.2 * NOISE)[0][-1], atol=1e-2)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (None, "config.json: no such file: a model folder holds config.json and model.safetensors"),
        ("{", "config.json: not JSON"),
        ("[]", "config.json: not a table"),
        ('{"model_type": "bert"}', "model_type = 'bert' is not wav2vec2"),
        ('{"model_type": "wav2vec2"}', "no wav2vec2 weights that can be read"),
    ],
)
def test_folder_that_is_no_model_is_one_clear_line(tmp_path, config, message):
    pytest.importorskip("transformers")
    if config is not None:
        (tmp_path / "config.json").write_text(config)
    with pytest.raises(ModelError, match=message):
        wav2vec2.Wav2Vec2(tmp_path)


def test_missing_extra_names_the_install(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    with pytest.raises(MissingExtra, match=r"pip install -e '.*\[wav2vec2\]'"):
        wav2vec2.Wav2Vec2(tmp_path)
