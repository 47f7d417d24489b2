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
from sympflow.integrators.methods import NAMES

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


@some
@given(t0=st.floats(-1e3, 1e3), dt=st.floats(1e-3, 10), n=st.integers(0, 10_000), backward=st.booleans())
def test_n_steps_of_dt_are_n_steps(t0, dt, n, backward):
    """⌊0.3/0.1⌋ is 2 in floating point: counts are integers, and times t0 + k·dt."""
    sign = -1 if backward else 1
    grid = Grid(t0, t0 + sign * n * dt, dt)
    assert grid.n_steps == n
    assert grid.remainder == 0
    k = n // 2
    assert grid.time(k) == t0 + k * grid.h


few = settings(max_examples=15, deadline=None)


states = hnp.arrays(float, 2, elements=st.floats(-1.2, 1.2))


@pytest.mark.parametrize("method", ["verlet", "rk45", "dopri5", "rk4", "gauss_legendre4", "log_leapfrog", "sympflow"])
@few
@given(
    y0=states,
    times=st.lists(st.floats(0, 2, allow_subnormal=False), min_size=1, max_size=6, unique=True),
    data=st.data(),
)
def test_fewer_output_times_do_not_change_the_others(method, y0, times, data):
    times = sorted(times)
    keep = sorted(data.draw(st.sets(st.sampled_from(range(len(times))), min_size=1)))
    options = {"t_span": (0, 2), "y0": y0 * 0.4}  # below the energy to which the logarithmic method is set
    everything = run(method, t_eval=times, **options)
    subset = run(method, t_eval=[times[i] for i in keep], **options)
    np.testing.assert_allclose(subset.y, everything.y[:, keep], rtol=1e-12, atol=1e-12)


METHODS = sorted(m for m in NAMES if getattr(get(m), "splitting", "") != "kepler")


FIXED = [m for m in METHODS if "dt" in get(m).options() and getattr(get(m), "on_grid", True) and not get(m).trained]


SPLITTINGS = [m for m in FIXED if get(m).symplectic]


@pytest.mark.parametrize("method", SPLITTINGS)
@few
@given(y0=states, dt=steps, n=st.integers(1, 12))
def test_time_reversal(method, y0, dt, n):
    """Symmetric methods on an even H: R ψ R = ψ⁻¹ with R(q, p) = (q, −p). All of them: the inverse undoes the steps."""
    integrator = get(method)(dt=dt)
    y = y0
    for _ in range(n):
        y = integrator.step(OSCILLATOR, 0.0, y, dt)
    for _ in range(n):
        y = integrator.inverse(OSCILLATOR, 0.0, y, dt)
    np.testing.assert_allclose(y, y0, atol=1e-11)
    if getattr(getattr(integrator, "scheme", None), "symmetric", False):
        R = np.array([1.0, -1.0])
        forward = integrator.step(OSCILLATOR, 0.0, y0, dt)
        back = R * integrator.step(OSCILLATOR, 0.0, R * forward, dt)
        np.testing.assert_allclose(back, y0, atol=1e-12)


batches = hnp.arrays(float, st.tuples(st.integers(1, 4), st.just(2)), elements=st.floats(-1.2, 1.2))


@pytest.mark.parametrize(
    "method", ["verlet", "kahan_li8", "rk4", "rk45", "implicit_midpoint", "impulse", "mlp", "sympflow"]
)
@few
@given(y0=batches, dt=steps)
def test_a_batch_is_a_loop(method, y0, dt):
    options = {"dt": dt} if "dt" in get(method).options() else {}
    together = run(method, (0, 1), y0, t_eval=[0.37, 1.0], **options)
    alone = [run(method, (0, 1), y, t_eval=[0.37, 1.0], **options).y for y in y0]
    np.testing.assert_allclose(together.y, alone, rtol=1e-11, atol=1e-11)
