"""A frame as graphs is the frame as it was."""

import numpy as np
import pytest
import torch
from tiny_arig import arig_listener, arig_model, streamed, talk

from sfms_robot.listeners import arig, checkpoint
from sfms_robot.listeners.arig import networks

INTEGERS = {"width": 256, "feedforward": 512, "heads": 4, "precision": "int8"}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"state_guidance": False, "visual": False, "interaction": "linear"},
        {"discrete": True},
        {"draws": "step"},
        {"events": True, "draws": "innovation", "sway": True},
        pytest.param(INTEGERS, marks=pytest.mark.skipif(not networks.supported(), reason="no fast integers here")),
    ],
    ids=str,
)
def test_graphs_make_the_same_frames_while_the_context_fills_and_after(changes):
    """The tiny model's context is full after twelve frames; its graphs are made before the first."""
    speaker = talk(20)
    before, after = (
        streamed(arig_listener(**changes), speaker),
        streamed(arig_listener(**changes).build_graphs(), speaker),
    )
    np.testing.assert_allclose(after, before, atol=1e-5)
    assert np.ptp(before[:, 6:], axis=0).max() > 1e-3


def test_a_listener_from_a_folder_runs_on_graphs(tmp_path):
    model = arig_model()
    checkpoint.save_config(tmp_path, model.settings)
    checkpoint.save_weights(tmp_path / checkpoint.WEIGHTS, model)
    found = arig.load(tmp_path).build_graphs()
    assert all(isinstance(part, torch.jit.ScriptModule) for part in found.engine._graphs.values())
    speaker = talk(5)
    np.testing.assert_allclose(streamed(found, speaker), streamed(arig_listener(), speaker), atol=1e-5)
