"""Functions that are the same at all points of the data are found in any units; of data that vary there are none."""

import numpy as np
import pytest
import sympy as sp

from sympflow.learning.parts import Distances
from sympflow.learning.unseen import unseen

random = np.random.default_rng(0)
angle = random.uniform(0, 2 * np.pi, (400, 1))
CIRCLE = np.concatenate([np.cos(angle), np.sin(angle), random.normal(size=(400, 2))], axis=1)
LINE = np.concatenate([random.normal(size=(400, 1)) * [1.0, 3.0], random.normal(size=(400, 2))], axis=1)
FREE = random.normal(size=(400, 4))
q1, q2 = sp.symbols("q1:3", real=True)


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
@pytest.mark.parametrize(("states", "found"), [(CIRCLE, q1**2 + q2**2), (LINE, q1 - q2 / 3), (FREE, None)])
def test_functions_that_are_the_same(states, found, noise, unit):
    seen = (states + noise * random.normal(size=states.shape)) * unit
    made = unseen(seen, np.full(4, noise * unit), range(2))
    if found is None:
        assert made == []
        return
    (g,) = made
    ratio = sp.Poly(g, q1, q2).as_expr().subs({q1: 0.7, q2: 0.4}) / found.subs({q1: 0.7, q2: 0.4})
    assert float(ratio) == pytest.approx(1, abs=0.01 + 0.4 * noise)  # two digits, and 5 √2 σ/√n


def test_an_offset_is_no_function():
    assert unseen(1e3 + FREE, np.zeros(4), range(4)) == []
    (g,) = unseen(1e3 + LINE, np.zeros(4), range(2))
    assert g.free_symbols == {q1, q2}


def test_bodies_at_one_distance():
    """Their place is no function of distances, and is not looked at."""
    bodies = np.array([[0, 1], [2, 3]])
    place = random.normal(size=(400, 2))
    q = np.concatenate([place, place + np.concatenate([np.cos(angle), np.sin(angle)], axis=1)], axis=1)
    states = np.concatenate([q, random.normal(size=q.shape)], axis=1)
    part = Distances.between(bodies, (2,), 1.0)
    assert len(unseen(states, np.zeros(8), range(4), part)) == 1
    states[:, 2:4] += random.normal(size=(400, 2))
    assert unseen(states, np.zeros(8), range(4), part) == []
