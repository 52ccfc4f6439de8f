"""A 16-wide model with seeded weights against outputs kept in tests/assets."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_arig import arig_listener, dyad_of, streamed, talk

GOLDEN = Path(__file__).parents[2] / "assets" / "arig_tiny.npz"


def outputs() -> dict[str, np.ndarray]:
    listener = arig_listener()
    speaker = talk(14)
    made = torch.from_numpy(np.random.default_rng(0).normal(size=(14, 58)).astype(np.float32))
    with torch.no_grad():
        found = listener.model.condition(dyad_of(listener, speaker, made))
    return {"z": found.z.numpy(), "states": found.states.numpy(), "motion": streamed(listener, speaker)}


@pytest.mark.parametrize("name", ["z", "states", "motion"])
def test_outputs_are_those_on_file(name: str):
    np.testing.assert_allclose(outputs()[name], np.load(GOLDEN)[name], rtol=1e-3, atol=1e-3)


if __name__ == "__main__":  # writes the file anew, for a change of the architecture that is meant
    np.savez_compressed(GOLDEN, **outputs())
