"""Laws of who is talked with when several faces are seen."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.sources.webcam import GONE_S, NEARER, TAKE_OVER_S, choose

STEP_S = 1 / 30
LEFT, RIGHT = np.array([0.6, 0.3, 0.0]), np.array([0.6, -0.3, 0.0])


def followed(pictures):
    """The chosen place in every picture (a list of places), None where nobody is."""
    before, out = None, []
    for number, places in enumerate(pictures):
        index, before = choose(places, number * STEP_S, before)
        out.append(None if index is None else places[index])
    return out


@given(st.lists(st.tuples(st.floats(0.93, 1.07), st.floats(0.93, 1.07), st.booleans()), min_size=1, max_size=120))
def test_of_two_that_are_equally_near_the_first_chosen_stays(sways):
    pictures = []
    for left, right, swapped in [(1.0, 1.01, False), *sways]:
        both = [left * LEFT, right * RIGHT]
        pictures.append(both[::-1] if swapped else both)
    assert all(place[1] > 0 for place in followed(pictures))


def test_one_who_is_clearly_nearer_takes_over_after_a_while_and_stays():
    near = 0.9 * NEARER * RIGHT
    chosen = followed([[LEFT]] * 10 + [[LEFT, near]] * 90)
    switches = [k for k in range(1, len(chosen)) if chosen[k] is not chosen[k - 1]]
    assert len(switches) == 1 and (switches[0] - 10) * STEP_S == pytest.approx(TAKE_OVER_S, abs=2 * STEP_S)


def test_one_who_leans_in_for_a_moment_only_does_not_take_over():
    near, moment = 0.9 * NEARER * RIGHT, [[LEFT, 0.9 * NEARER * RIGHT]] * round(0.8 * TAKE_OVER_S / STEP_S)
    pictures = ([[LEFT, near]] + moment + [[LEFT, RIGHT]]) * 5
    assert all(place is LEFT for place in followed([[LEFT]] + pictures))


def test_another_is_chosen_only_once_the_chosen_one_is_gone():
    chosen = followed([[LEFT]] + [[RIGHT]] * 60)
    alone = [place is None for place in chosen[1:]]
    taken = alone.index(False)
    assert taken * STEP_S == pytest.approx(GONE_S, abs=2 * STEP_S) and not any(alone[taken:])


def test_one_who_is_hidden_for_a_moment_is_the_same_person_afterwards():
    hidden = [[RIGHT]] * round(0.8 * GONE_S / STEP_S)
    assert all(place is LEFT or place is None for place in followed([[LEFT, RIGHT]] + hidden + [[RIGHT, LEFT]] * 5))


def test_a_face_is_followed_as_it_walks():
    walk = [[np.array([0.6, y, 0.0]), np.array([0.9, 0.0, 0.1])] for y in np.linspace(-0.4, 0.4, 60)]
    assert all(place[0] == 0.6 for place in followed(walk))


@given(st.permutations(range(3)))
def test_the_order_of_the_faces_does_not_matter(order):
    faces = [LEFT, 0.7 * RIGHT, 1.5 * LEFT]
    assert followed([[faces[k] for k in order]])[0] is faces[1]


def test_nobody():
    assert choose([], 0.0, None) == (None, None)
