"""`export --weight-bits`: the same listener, stored in less room."""

import numpy as np
import pytest

from sfms_robot.app.catalogue import export_listener
from sfms_robot.data import data_dir
from sfms_robot.listeners.checkpoint import WEIGHTS, read_weights


@pytest.mark.slow
def test_what_ships_in_8_bits_is_what_its_weights_in_32_bits_give(tmp_path):
    shipped = data_dir("configs") / "listeners" / "sfms-small" / WEIGHTS
    assert tmp_path / WEIGHTS in export_listener("sfms-small", tmp_path, False, 32)
    wide, narrow = read_weights(tmp_path / WEIGHTS), read_weights(shipped)
    assert (tmp_path / WEIGHTS).stat().st_size > 3 * shipped.stat().st_size
    assert wide.keys() == narrow.keys()
    for name, value in narrow.items():
        np.testing.assert_array_equal(wide[name], value)
