"""ensemble(): the same bits whatever the workers and chunks; a failed orbit is a row; what is kept of each."""

import numpy as np
import pytest

import sympflow

SYSTEM = sympflow.systems.henon_heiles()
STATES = SYSTEM.domain.sample(200, 1)
SPAN, DT = (0.0, 5.0), 0.1


def kept(**how):
    return sympflow.ensemble(SYSTEM, "verlet", SPAN, STATES, dt=DT, **how)


def test_states_are_those_of_solve():
    times = [0.0, 1.0, 4.95]
    result = kept(t_eval=times)
    assert np.array_equal(result.y, sympflow.solve(SYSTEM, "verlet", SPAN, STATES, dt=DT, t_eval=times).y)
    assert np.array_equal(result.t, times)
    assert result.success
    assert not result.messages


@pytest.mark.parametrize("chunk", [1, 37, 64, 1000])
@pytest.mark.parametrize("workers", [1, 2, map])
def test_the_same_bits_whatever_the_workers_and_chunks(workers, chunk):
    reference = sympflow.solve(SYSTEM, "verlet", SPAN, STATES, dt=DT, t_eval=[SPAN[1]]).y[..., 0]
    assert np.array_equal(kept(reduce="final", workers=workers, chunk=chunk).final, reference)


@pytest.mark.parametrize(("method", "options"), [("verlet", {"backend": "array"}), ("dop853", {})])
def test_the_same_bits_where_python_runs(method, options):
    def final(chunk):
        return sympflow.ensemble(SYSTEM, method, (0, 1), STATES[:80], reduce="final", chunk=chunk, **options).final

    reference = final(80)
    for chunk in (1, 7, 64):
        assert np.array_equal(final(chunk), reference)


def test_a_failed_orbit_is_a_row():
    states = STATES.copy()
    states[[3, 70]] = 60.0
    result = sympflow.ensemble(SYSTEM, "verlet", SPAN, states, dt=DT, reduce="final", chunk=64, workers=2)
    good = np.delete(np.arange(len(states)), [3, 70])
    assert np.flatnonzero(result.status).tolist() == [3, 70]
    assert np.isnan(result.final[[3, 70]]).all()
    assert np.array_equal(result.final[good], kept(reduce="final").final[good])
    assert set(result.messages) == {(3,), (70,)}
    assert "non-finite after t = " in result.message


def test_states_are_drawn_alike_in_any_chunks():
    def drawn(y0, chunk):
        return sympflow.ensemble(SYSTEM, "verlet", (0, 1), y0, n=5000, seed=3, chunk=chunk, reduce="final", dt=DT).final

    for y0 in (SYSTEM.domain, lambda rng, n: 0.1 * rng.standard_normal((n, 4))):
        assert np.array_equal(drawn(y0, 5000), drawn(y0, 999))


def test_a_users_function():
    result = kept(reduce=lambda t, y: {"largest": y[0].max(), "ends": y[:, [0, -1]]}, chunk=50)
    states = kept().y
    assert np.array_equal(result.largest, states[:, 0].max(axis=-1))
    assert np.array_equal(result.ends, states[..., [0, -1]])
    errors = kept(reduce="energy_error").energy_error
    H = SYSTEM.hamiltonian(states.swapaxes(1, 2))
    assert np.allclose(errors, np.abs(H / H[:, :1] - 1).max(1), rtol=1e-9)
