"""Laws of the public API, on random input (hypothesis): what must hold for every method, state and time."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from watchdog import watched

import sympflow
from sympflow import get, solve, systems
from sympflow.integrators.grid import Grid

pytestmark = pytest.mark.slow

OSCILLATOR = systems.harmonic_oscillator()
some = settings(max_examples=40, deadline=None)

steps = st.floats(0.01, 0.3)


def run(method, *arguments, **options):
    """A run of laws that hold for steps too long to be right, too."""
    return solve(OSCILLATOR, method, *arguments, backend="array", diagnose=False, **options)


# grid arithmetic ------------------------------------------------------------------------------------------------


@some
@given(t0=st.floats(-1e3, 1e3), length=st.floats(0.01, 1e3), dt=st.floats(1e-2, 10), x=st.floats(0, 1))
def test_every_time_is_a_count_and_a_remainder(t0, length, dt, x):
    grid = Grid(t0, t0 + length, dt)
    t = min(max(t0 + x * length, t0), grid.t1)
    (count,), (remainder,) = grid.locate(np.array([t]))
    assert grid.place(t) == (count, remainder)
    assert 0 <= count <= grid.n_steps
    assert 0 <= remainder < dt
    assert t0 + count * dt + remainder == pytest.approx(t, abs=1e-12 * (1 + abs(t0) + length))


# solve: outputs -------------------------------------------------------------------------------------------------


# solve: whatever it is given ------------------------------------------------------------------------------------

numbers = st.one_of(st.floats(), st.integers(), st.booleans(), st.none(), st.complex_numbers(), st.text(max_size=3))
arrays = hnp.arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.complex128, np.bool_, np.dtype("U1"), np.float16]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)
anything = st.one_of(numbers, arrays, st.lists(numbers, max_size=4), st.dictionaries(numbers, numbers, max_size=2))
ARGUMENTS = ["t_span", "y0", "t_eval", "dense_output", "save_every", "dtype", "backend", "on_domain_exit"]
OPTIONS = ["dt", "rtol", "atol", "max_step", "first_step", "compensated", "tol", "flow", "max_order"]


def refused(call):
    """The result of a call, or None if it was refused as it should be: by a message that names an argument."""
    refusal = None
    with watched():
        try:
            return call()
        except (ValueError, TypeError) as error:
            refusal = str(error)
    assert refusal.startswith("`")
    assert refusal.rstrip().endswith((".", "?"))
    return None


@pytest.mark.parametrize(
    "method", ["verlet", "rk45", "dopri5", "explicit_adams", "implicit_midpoint", "log_leapfrog", "mlp"]
)
@settings(max_examples=60, deadline=None)
@given(argument=st.sampled_from(ARGUMENTS), value=anything)
def test_solve_takes_or_refuses_anything(method, argument, value):
    """No other exception than those that name the argument, and no result that is silently wrong in kind."""
    arguments = {"t_span": (0.0, 0.2), "backend": "array", argument: value}
    sol = refused(lambda: solve(OSCILLATOR, method, **arguments))
    if sol is not None:
        assert np.isfinite(np.asarray(sol.y)).all() or (np.asarray(sol.status) == -1).any()
        assert sol.y.shape[-1] == len(sol.t)


@pytest.mark.filterwarnings("ignore:At least one element of `rtol` is too small")  # SciPy's
@pytest.mark.filterwarnings("ignore:`(dt|rtol)` .*is too")  # one that is drawn may lose energy
@pytest.mark.parametrize("option", OPTIONS)
@settings(max_examples=40, deadline=None)
@given(value=anything)
@example(value=4.5e61)  # a dt whose cube a float can hold, and whose fifth power it can not
@example(value=np.array([]))  # compares with nothing
def test_options_are_taken_or_refused(option, value):
    # a dt of up to 1e11 steps is taken, and the run takes minutes
    assume(option != "dt" or not isinstance(value, float) or not 2e-12 <= value <= 2e-10)
    for method in ("verlet", "rk45", "dopri5", "explicit_adams", "sympflow"):
        if option in get(method).options():
            sol = refused(lambda m=method: solve(OSCILLATOR, m, (0.0, 0.2), t_eval=[0.2], **{option: value}))
            assert sol is None or sol.status == -1 or (np.isfinite(sol.y).all() and sol.t.tolist() == [0.2])


DOMAINS = [sympflow.Ball, sympflow.Box, sympflow.EnergySublevel, sympflow.Tube]


@settings(max_examples=100, deadline=None)
@given(kind=st.sampled_from(DOMAINS), a=anything, b=anything)
def test_domains_are_made_or_refused(kind, a, b):
    domain = refused(lambda: kind(a, b))
    assert domain is None or kind is sympflow.EnergySublevel or np.isfinite(domain.sample(2, 0)).all()
