"""`evaluate --hop N`: the hops that a run may choose, and no other."""

import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.lab.evaluation.rollout import load_at_hop


@pytest.mark.parametrize(("hop", "plans_every"), [(None, 4), (2, 2), (8, 8)])
def test_a_listener_plans_as_often_as_it_is_told(hop, plans_every):
    assert load_at_hop("sfms-small", hop).hop == plans_every


@pytest.mark.parametrize(
    ("listener", "hop", "choices"), [("sfms-small", 9, "1, 2, 3, 4, 5, 6, 7, 8"), ("arig-small", 2, "1")]
)
def test_a_hop_that_it_cannot_be_run_with_is_refused_with_the_choices(listener, hop, choices):
    with pytest.raises(ConfigError, match=rf"^--hop {hop}: not a hop of listener {listener} \(valid: {choices}\)$"):
        load_at_hop(listener, hop)
