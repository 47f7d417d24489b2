"""Functions of a user that contradict each other are refused when they are first used; right ones never are."""

import warnings

import numpy as np
import pytest
import torch
from numba import njit

from sympflow import Ball, HamiltonianSystem, poincare_section, solve, systems, time_transformed, train
from sympflow.interop.scipy import as_scipy
from sympflow.systems.chains import EPSILON, MASS, SIGMA
from sympflow.systems.pairs import pair_functions

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")

Y1, Y2 = np.array([1.0, 0.3]), np.array([0.3, 0.6, 0.1, 0.2])
SQUARE = {"potential": lambda q: (q**2).sum(-1) / 2, "ndof": 1}
QUARTIC = {"potential": lambda q: (q**4).sum(-1) / 4, "ndof": 2}
PLANE = {"potential": lambda q: q[..., 0] ** 2 / 2 + 2 * q[..., 1] ** 2, "ndof": 2}

MIXED = {
    "potential": lambda q: q[..., 0] ** 2 / 2e12 - 1e-7 / q[..., 1],
    "gradient": lambda q: np.stack([q[..., 0] / 1e12, 1e7 / (1e7 * q[..., 1]) ** 2], -1),
    "hessian_vector": lambda q, v: v * np.stack([0 * q[..., 0] + 1e-12, -2e-7 / q[..., 1] ** 3], -1),
    "ndof": 2,
}


def within(q):
    if (q > 1).any():
        raise ValueError("beyond the end")
    return q


def edge(q):
    return 0.5 / np.sqrt(1 - within(q))


def counting():
    """A potential that differs at each call."""
    calls = []

    def potential(q):
        calls.append(q)
        return (q**2).sum(-1) * (1 + 1e-3 * len(calls))

    return potential


def assert_refused(message, y0, **functions):
    with pytest.raises((ValueError, TypeError), match=message) as error:
        HamiltonianSystem(**functions).check_functions(y0)
    assert "check=False" in str(error.value)
    HamiltonianSystem(**functions, check=False).check_functions(y0)


def assert_accepted(y0, **functions):
    """Assert that the functions are called for a test, pass it without a warning, and are not tested again."""
    name = "hamiltonian" if "hamiltonian" in functions else "potential"
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return functions[name](*arguments)

    system = HamiltonianSystem(**functions | {name: counted})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        system.check_functions(y0)
        n = len(calls)
        system.check_functions(y0)
    assert 4 < n <= len(calls) <= n + 2  # two values are compared with what was traced


@pytest.mark.parametrize(
    ("functions", "y0", "message"),
    [
        (
            {"potential": lambda q: (q.detach() ** 2).sum(-1), "ndof": 1},
            Y1,
            r"^`potential` is cut off .* at q = \(1\) component 0 of its gradient is 0, but it grows by 2 a unit",
        ),
        (
            {"potential": lambda q: (q**2).sum(-1) + (q.detach() ** 4).sum(-1), "ndof": 1},
            Y1,
            r"^`potential` is in part cut off .* component 0 of its gradient is 2, but it grows by 6 a unit",
        ),
        (
            {"hamiltonian": lambda q, p: (q.detach() ** 2 + p**2).sum(-1), "ndof": 1},
            Y1,
            r"^`hamiltonian` is cut off .* at \[q, p\] = \(1, 0\.3\) component 0 .* grows by 2",
        ),
        (
            SQUARE | {"gradient": lambda q: -q},
            Y1,
            r"^`gradient` is not that of `potential`: at q = \(1\) its component 0 is -1, but `potential` grows by 1",
        ),
        (SQUARE | {"gradient": lambda q: 1.001 * q}, Y1, r"component 0 is 1\.001, but `potential` grows by 1 a unit"),
        (
            QUARTIC | {"gradient": lambda q: q**3 * np.array([1, -1])},
            Y2,
            r"at q = \(0\.3, 0\.6\) its component 1 is -0\.216, but `potential` grows by 0\.216 a unit",
        ),
        (
            PLANE | {"gradient": lambda q: np.array([q[0], 4 * q[1]])},
            Y2,
            r"^`gradient` gives a batch other values .* is 2\.4 alone, 0\.6 in a batch of shape \(2, 2\)",
        ),
        (
            {"potential": lambda q: q[0] ** 2 + (q**2).sum(-1), "ndof": 2},
            Y2,
            r"^`potential` must return shape \(\) for a state part of shape \(2,\)|^`potential` gives a batch other",
        ),
        (
            {"potential": lambda q: (q * q).sum() if q.ndim == 1 else (q * q).sum(-1) / 2, "ndof": 2},
            Y2,
            r"^`potential` gives a batch other values than single states: its result at q = \(0\.3, 0\.6\)",
        ),
        (
            QUARTIC | {"gradient": lambda q: q**3, "hessian_vector": lambda q, v: 3 * q * v},
            Y2,
            r"^`hessian_vector` is not the derivative of `gradient`: at q = \(0\.3, 0\.6\), along v = ",
        ),
        (
            QUARTIC | {"gradient": lambda q: q**3, "hessian_vector": lambda q, v: (3 * q**2 * v).sum(-1)},
            Y2,
            r"^`hessian_vector` must return shape \(2,\)",
        ),
        (QUARTIC | {"potential": lambda q: (q.float() ** 4).sum(-1)}, Y2, "^`potential` returns float32 for a state"),
        ({"potential": counting(), "ndof": 1}, Y1, r"^`potential` gives another value each time: at q = \(1\)"),
        (
            MIXED | {"gradient": lambda q: np.stack([q[..., 0] / 1e12, 1.01e7 / (1e7 * q[..., 1]) ** 2], -1)},
            np.array([1e6, 1e-7, 0.1, 0.2]),
            r"its component 1 is 1\.01e\+07, but `potential` grows by 1e\+07",
        ),
        (
            {"hamiltonian": lambda q, p: (p.detach() ** 2).sum(-1) / 2e-26 + 1e-2 * (q**2).sum(-1), "ndof": 1},
            np.array([1e-10, 1e-23]),
            "^`hamiltonian` is cut off .* component 1",
        ),
        (
            QUARTIC | {"ndof": 300, "gradient": lambda q: q**3 * (1 + (np.arange(300) == 177))},
            np.linspace(-1, 1, 600),
            "its component 177 is ",
        ),
        (
            SQUARE | {"gradient": lambda q: np.where(q > 2, 2 * q, q), "domain": Ball([3.0, 0.0], 1.0)},
            Y1,
            "^`gradient` is not that of `potential`",
        ),
    ],
)
def test_contradictions_are_named_with_the_component_the_state_and_both_values(functions, y0, message):
    assert_refused(message, y0, **functions)


@pytest.mark.parametrize(
    ("functions", "y0"),
    [
        ({"potential": lambda q: 0 * q.sum(-1), "ndof": 1}, Y1),
        ({"potential": lambda q: abs(q).sum(-1), "ndof": 1}, np.array([0.0, 1.0])),
        ({"potential": lambda q: torch.relu(q - 1).sum(-1), "ndof": 1}, np.array([1.0, 1.0])),
        ({"potential": lambda q: abs(q).sum(-1), "gradient": np.sign, "ndof": 1}, np.array([0.0, 1.0])),
        (
            {"potential": lambda q: np.maximum(q, 0).sum(-1), "gradient": lambda q: (q >= 0) * 1.0, "ndof": 1},
            np.zeros(2),
        ),
        (
            {
                "potential": lambda q: 1e12 * q[..., 0] ** 2 / 2 + q[..., 1] ** 2,
                "gradient": lambda q: q * np.array([1e12, 2]),
                "ndof": 2,
            },
            Y2,
        ),
        (SQUARE | {"potential": lambda q: 1e12 + (q**2).sum(-1) / 2, "gradient": lambda q: q}, Y1),
        (
            SQUARE
            | {"potential": lambda q: (1e9 * np.cos(q) - 1e9 * np.cos(q) + q**2 / 2).sum(-1), "gradient": lambda q: q},
            Y1,
        ),
        ({"potential": lambda q: -1 / (q**2).sum(-1) ** 0.5, "ndof": 2}, np.array([1e-8, 0, 0, 1.0])),
        ({"potential": lambda q: -1e20 / (q**2).sum(-1) ** 0.5, "ndof": 2}, np.array([1.5e11, 0, 0, 1e4])),
        (
            {"potential": lambda q: -np.sqrt(q).sum(-1), "gradient": lambda q: -0.5 / np.sqrt(q), "ndof": 1},
            np.array([1e-9, 0.0]),
        ),
        (QUARTIC | {"ndof": 300, "gradient": lambda q: q**3}, np.linspace(-1, 1, 600)),
        ({"potential": lambda q: (1 / torch.clamp(q, min=0.0)).sum(-1), "ndof": 1}, np.array([-1.0, 0.0])),
        (MIXED, np.array([1e6, 1e-7, 0.1, 0.2])),
        ({"potential": lambda q: torch.cos(1e6 * q).sum(-1), "ndof": 1}, np.array([3.0, 1.0])),
        (
            {"hamiltonian": lambda q, p: (p**2).sum(-1) / 2e9 - 1e10 * torch.cos(q).sum(-1), "ndof": 1},
            np.array([0.3, 1e9]),
        ),
        (
            {"potential": lambda q: -np.sqrt(1 - within(q)).sum(-1), "gradient": edge, "ndof": 1},
            np.array([1 - 1e-9, 0]),
        ),
    ],
    ids=[
        *("free", "kink", "relu at its kink", "sign at its kink", "a slope of a kink", "stiff", "far from 0", "noisy"),
        *("singular", "other units", "next to the end of its domain", "many", "infinite", "scales far apart"),
        *("a short period", "an angle and a large momentum", "raises beyond its domain"),
    ],
)
def test_right_functions_pass(functions, y0):
    assert_accepted(y0, **functions)


FAR = QUARTIC | {"gradient": lambda q: np.where(abs(q) > 2, 0, q**3), "y0": np.array([0.3, 0.2, 3.0, 3.0])}


@pytest.mark.parametrize("t_eval", [None, [0.8]])
@pytest.mark.parametrize("method", ["verlet", "rk45"])
def test_a_run_that_goes_where_the_functions_are_wrong_warns(method, t_eval):
    with pytest.warns(RuntimeWarning, match=r"^On this run, far from its start: `gradient` is not that of `potential`"):
        solve(HamiltonianSystem(**FAR), method, (0, 4 if t_eval is None else 0.8), t_eval=t_eval)


def test_every_door_tests():
    wrong = SQUARE | {"gradient": lambda q: -q, "y0": Y1, "domain": Ball([0.0, 0.0], 1.0)}
    doors = [
        lambda s: solve(s, "verlet", (0, 1)),
        lambda s: solve(s, "rk45", (0, 1), torch.tensor(Y1)),
        lambda s: solve(time_transformed(s), "leapfrog", (0, 1)),
        train,
        lambda s: as_scipy("verlet", s),
        lambda s: poincare_section(s, "verlet", (0, 1)),
    ]
    for door in doors:
        with pytest.raises(ValueError, match=r"^`gradient` is not that of `potential`"):
            door(HamiltonianSystem(**wrong))


@njit
def potential(q):
    return q[0] ** 2 / 2 + 2 * q[1] ** 2


@njit
def partly(q, out):
    out[0] = q[0]


@njit
def adding(q, out):
    out[0] += q[0]
    out[1] += 4 * q[1]


@njit
def doubled(q, out):
    out[0] = q[0]
    out[1] = 8 * q[1]


@njit
def overwriting(q, out):
    out[0], out[1] = q[0], 4 * q[1]
    q[0] = 0.0


@njit
def gradient(q, out):
    out[0], out[1] = q[0], 4 * q[1]


@njit
def wrong_product(q, v, out):
    out[0], out[1] = v[0], v[1]


class TestNumbaFunctions:
    @pytest.mark.parametrize(
        ("functions", "message"),
        [
            ({"gradient": partly}, r"^`gradient` does not set out\[1\] at \(0\.3, 0\.6\)"),
            ({"gradient": adding}, r"^`gradient` does not set out\[0\]"),
            ({"gradient": doubled}, r"its component 1 is 4\.8, but `potential` grows by 2\.4 a unit"),
            ({"gradient": overwriting}, r"^`gradient` writes into its argument"),
            ({"gradient": gradient, "hessian_vector": wrong_product}, r"^`hessian_vector` is not the derivative"),
        ],
    )
    def test_that_are_wrong_are_named(self, functions, message):
        assert_refused(message, Y2, potential=potential, ndof=2, **functions)

    def test_what_is_not_written_is_not_finite(self):
        """Untested, it ends the run rather than take what memory holds."""
        unchecked = HamiltonianSystem(potential, gradient=partly, ndof=2, check=False)
        assert np.isnan(unchecked.force(Y2[:2])).tolist() == [False, True]
        assert solve(unchecked, "verlet", (0, 1), Y2, dt=0.1).status == -1

    def test_that_are_right_pass(self):
        system = HamiltonianSystem(potential, gradient=gradient, ndof=2)
        system.check_functions(Y2)
        np.testing.assert_allclose(system.force(Y2[:2]), [-0.3, -2.4])


@njit
def lennard_jones(s):
    x = (SIGMA * SIGMA / s) ** 3
    return 4 * EPSILON * (x * x - x), EPSILON * (12 * x - 24 * x * x) / s, EPSILON * (168 * x * x - 48 * x) / s**2


def test_sums_over_pairs_by_numba_functions_are_those_by_a_formula():
    system = systems.lennard_jones()
    given = pair_functions(lennard_jones, np.ones((7, 7)), 2)
    again = HamiltonianSystem(**given, mass=MASS, domain=system.domain, y0=system.y0)
    assert again.functions_given
    again.check_functions()
    q, v = system.y0[: system.ndof], np.random.default_rng(0).standard_normal(system.ndof)
    assert again.potential(q) == pytest.approx(system.potential(q), rel=1e-14)
    np.testing.assert_allclose(again.force(q), system.force(q), rtol=0, atol=1e-14 * 42 * 4 * EPSILON / SIGMA)
    exact = system.hessian_vector(q, v)
    np.testing.assert_allclose(again.hessian_vector(q, v), exact, rtol=0, atol=1e-13 * abs(exact).max())


@pytest.mark.parametrize(
    ("functions", "y0"),
    [
        ({"potential": lambda q: torch.cos(1e6 * q).sum(-1), "ndof": 1}, np.array([3.0, 1.0])),
        (
            {"hamiltonian": lambda q, p: (p**2).sum(-1) / 2e9 - 1e10 * torch.cos(q).sum(-1), "ndof": 1},
            np.array([0.3, 1e9]),
        ),
        (
            {"potential": lambda q: -np.sqrt(1 - within(q)).sum(-1), "gradient": edge, "ndof": 1},
            np.array([1 - 1e-9, 0]),
        ),
    ],
    ids=["a period shorter than a difference", "an angle and a large momentum", "raises beyond its domain"],
)
def test_what_differences_cannot_resolve_is_not_refused(functions, y0):
    assert_accepted(y0, **functions)


def test_one_wrong_component_of_many_is_found():
    def gradient(q):
        return q**3 * (1 + (np.arange(300) == 177))

    assert_refused(r"its component 177 is ", np.linspace(-1, 1, 600), **QUARTIC | {"ndof": 300, "gradient": gradient})


def test_a_contradiction_elsewhere_in_the_domain_is_found():
    wrong = SQUARE | {"gradient": lambda q: np.where(q > 2, 2 * q, q), "domain": Ball([3.0, 0.0], 1.0)}
    assert_refused("^`gradient` is not that of `potential`", Y1, **wrong)
