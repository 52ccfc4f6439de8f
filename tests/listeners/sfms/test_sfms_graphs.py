"""A plan as graphs is the plan as it was."""

import numpy as np
import pytest
import torch
from tiny_sfms import plans_of, speech, tiny_listener

from sfms_robot.listeners import checkpoint, sfms


@pytest.mark.parametrize(
    "changes",
    [{}, {"sequential": False, "phase": False}, {"quantizer": "vq", "inpainter": "paper"}],
    ids=str,
)
def test_graphs_make_the_same_plans(changes):
    speaker = speech(40)
    before, after = (
        plans_of(tiny_listener(**changes), speaker),
        plans_of(tiny_listener(**changes).build_graphs(), speaker),
    )
    assert before.keys() == after.keys() and len(after) >= 5
    for index, plan in before.items():
        np.testing.assert_allclose(after[index].frames, plan.frames, atol=1e-5)


def test_many_streams_at_once_are_none_the_worse_for_the_graphs_of_one():
    found = tiny_listener().build_graphs()
    memories, alone = (
        [found.start(seed) for seed in (1, 2, 3)],
        [plans_of(found, speech(9), seed) for seed in (1, 2, 3)],
    )
    for index, frame in enumerate(speech(9)):
        plans, memories = found.step_many(frame, memories)
        for plan, own in zip(plans, alone, strict=False):
            np.testing.assert_allclose(plan.frames, own[index].frames, atol=1e-5)


def test_a_listener_from_a_folder_runs_on_graphs(tmp_path):
    plain = tiny_listener()
    checkpoint.save_config(tmp_path, plain.settings)
    checkpoint.save_weights(tmp_path / checkpoint.WEIGHTS, plain.model)
    found = sfms.load(tmp_path).build_graphs()
    assert all(isinstance(part, torch.jit.ScriptModule) for part in found.engine._graphs.values())
