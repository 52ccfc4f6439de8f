"""A listener that is told what happens: what it does with events, with gaze, and with its conversational states."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_arig import arig_listener, arig_model, dyad_of, soft, streamed, talk

from sfms_robot.config.listener import EVENT_STATES, STATES, paper_state
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, ListenerEvent
from sfms_robot.listeners.arig.stream import (
    FEEDBACK,
    LISTENING,
    NODDING,
    SMILING,
    ArigListener,
    Sojourn,
    draw_sojourn,
    with_feedback,
)
from sfms_robot.listeners.idle import sway_at
from sfms_robot.signals.control import COLUMNS, control_track

TOLD = {"events": True, "draws": "innovation"}
SWAYS = TOLD | {"sway": True}
HEAD = slice(0, 6)
EYES = [index for name, index in CHANNEL_INDEX.items() if name.startswith("eyeLook")]
FACE = [index for name, index in CHANNEL_INDEX.items() if index >= 6 and index not in EYES]


@pytest.fixture(scope="module")
def told() -> ArigListener:
    return soft(arig_listener(**TOLD))


def nods(frames: int, *starts_s: float) -> np.ndarray:
    """(frames, K) of nods of half a second."""
    return control_track([ListenerEvent("nod", start, 0.5, 0.1, 2) for start in starts_s], 0, frames)


@pytest.mark.parametrize("changed_from", [2, 9, 20])
def test_later_control_never_changes_earlier_plans(told, changed_from: int):
    """The plan made at frame t shows frame t + 1, and is told its row."""
    speaker, control = talk(24), nods(25, 0.2)
    other = control.copy()
    other[changed_from + 1 :] = nods(25, changed_from * FRAME_S)[changed_from + 1 :] + 0.5
    before, after = streamed(told, speaker, 1, control), streamed(told, speaker, 1, other)
    np.testing.assert_array_equal(before[:changed_from], after[:changed_from])
    assert not np.array_equal(before[changed_from:], after[changed_from:])


@pytest.mark.parametrize("draws", ["motion", "step", "innovation"])
def test_eyes_rest_whatever_the_weights_say(draws: str):
    out = streamed(soft(arig_listener(events=True, draws=draws)), talk(8), 1, nods(9, 0.1))
    assert not out[:, EYES].any() and out[:, FACE].std() > 0


@given(
    scores=st.lists(st.floats(-20, 20), min_size=9, max_size=9),
    possible=st.lists(st.booleans(), min_size=7, max_size=7).filter(any),
    state=st.integers(0, 6),
    left=st.integers(0, 5),
    uniforms=st.tuples(st.floats(0, 1, exclude_max=True, width=32), st.floats(0, 1, exclude_max=True, width=32)),
)
def test_a_state_is_one_that_the_voices_leave_and_lasts_as_long_as_was_drawn(scores, possible, state, left, uniforms):
    voices, durations = np.ones((2, 2, 7), np.float32), np.tile(np.linspace(2, 9, 33, dtype=np.float32), (7, 1))
    voices[0, 1] = possible
    before = Sojourn(state, left)
    found = draw_sojourn(durations, voices, np.array(scores, np.float32), (False, True), before, np.array(uniforms))
    assert possible[found.state]
    if possible[state] and left:
        assert found == Sojourn(state, left - 1)
    else:
        assert 1 <= found.left <= 8
        assert found.state != state or sum(possible) == 1


def test_feedback_that_is_seen_is_known_from_the_events():
    rows = control_track([ListenerEvent("nod", 0.0, 0.2, 0.1), ListenerEvent("smile", 0.12, 0.2, 0.5)], 0, 9)
    seen = with_feedback(np.full(9, LISTENING), rows).tolist()
    assert seen == [NODDING] * 4 + [SMILING] * 3 + [LISTENING] * 2
    assert with_feedback(np.full(9, FEEDBACK), rows).tolist()[:7] == seen[:7]
    for other in (-1, STATES.index("speaking"), STATES.index("waiting")):
        assert with_feedback(np.full(9, other), rows).tolist() == [other] * 9
    assert [paper_state(state) for state in (LISTENING, NODDING, SMILING)] == [LISTENING, FEEDBACK, FEEDBACK]
    assert EVENT_STATES[: len(STATES)] == STATES


def test_a_stream_nods_its_feedback(told):
    """While the user is heard and a nod is under way, a listening stream gives feedback by it."""
    memory, control, found = told.start(1), nods(41, 0.4, 1.0), []
    with torch.no_grad():
        told.model.states.possible.zero_()
        told.model.states.possible[..., LISTENING] = True
    for index, frame in enumerate(talk(40)):
        _, memory = told.step(frame, memory, control[index : index + 2])
        found.append(memory.state)
    told.model.states.possible.fill_(True)
    active = control[1:, COLUMNS.index("nod.active")] > 0
    assert found == np.where(active, NODDING, LISTENING).tolist()


@given(rho=st.floats(0.0, 0.999), place=st.floats(-5, 5), other=st.floats(-5, 5), drawn=st.floats(-3, 3))
def test_what_was_drawn_wrongly_is_forgotten_at_the_rate_of_the_data(rho, place, other, drawn):
    model = arig_model(draws="innovation")
    model.rho.fill_(rho)
    model.motion_low.fill_(-100)
    model.motion_high.fill_(100)
    one, two = (model.drawn(torch.full((58,), drawn), torch.full((58,), each)) for each in (place, other))
    torch.testing.assert_close(one - two, torch.full((58,), rho * (place - other)), rtol=1e-4, atol=1e-4)
    assert torch.allclose(model.moved(one, torch.full([58], place)), torch.full([58], drawn), rtol=1e-3, atol=1e-3)


def test_independent_draws_stay_where_the_data_are():
    """Innovations as large as those of a process of deviation 1 make places of deviation 1, however long it runs."""
    model = arig_model(draws="innovation")
    model.rho.fill_(0.9)
    model.step_std.fill_(((1 - 0.9**2) / ((np.e**2 - 1) / 2)) ** 0.5)  # the power of sinh of normal numbers
    generator, place, places = torch.Generator().manual_seed(0), torch.zeros(58), []
    for _ in range(9_000):
        place = model.drawn(torch.randn(58, generator=generator), place)
        places.append(place)
    for part in torch.stack(places).chunk(4):
        assert float(part.std()) == pytest.approx(1.0, abs=0.1) and abs(float(part.mean())) < 0.1


def test_what_is_drawn_of_a_head_that_sways_apart_knows_nothing_of_where_it_was():
    """The network cannot feed on the head it made: a stream whose head was elsewhere draws the same."""
    listener, speaker = soft(arig_listener(**SWAYS)), talk(20)
    model, generator = listener.model, torch.Generator().manual_seed(0)
    motion = torch.rand(20, 58, generator=generator)
    other = motion.clone()
    other[:, HEAD] += torch.randn(20, 6, generator=generator)
    dyads = [dyad_of(listener, speaker, each, nods(21, 0.2)) for each in (motion, other)]
    states = torch.zeros(1, 21, dtype=torch.long)
    with torch.no_grad():
        one, two = (model.condition(each, states) for each in dyads)
    assert not torch.equal(one.moved, two.moved)
    torch.testing.assert_close(one.z, two.z, rtol=0, atol=0)
    torch.testing.assert_close(one.outline, two.outline, rtol=0, atol=0)


def test_how_the_head_sways_is_added_and_changes_nothing_else():
    """A stream's sway is a function of its seed and of time: nothing that is drawn knows of it."""
    speaker, control = talk(90), nods(91, 0.4, 2.0)
    still, swaying = (soft(arig_listener(**SWAYS)) for _ in range(2))
    with torch.no_grad():
        swaying.model.sway_mixture.copy_(0.01 * torch.eye(6))
    one, other = (streamed(listener, speaker, 5, control) for listener in (still, swaying))
    sway = sway_at(swaying.start(5).sway, FRAME_S * np.arange(2, 92))
    np.testing.assert_allclose((other - one)[:, HEAD], sway, atol=1e-6)
    np.testing.assert_array_equal(one[:, 6:], other[:, 6:])
    assert np.abs(sway).max() > 0.01


def test_nothing_is_drawn_that_is_faster_than_the_data():
    """Whatever the mean of what is drawn is, and whatever is drawn beside it."""
    listener = soft(arig_listener(**TOLD))
    with torch.no_grad():
        listener.model.head.low.fill_(-1.5)
        listener.model.head.high.fill_(2.0)
        listener.model.mean[-1].bias.fill_(9.0)
        z = torch.randn(7, listener.model.mean[0].in_features)
        found = listener.model.sample(z, torch.randn(7, *listener.noise_shape))
        assert float(found.max()) == 2.0 and float(found.min()) >= -1.5
