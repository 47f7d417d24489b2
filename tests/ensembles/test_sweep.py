"""ensemble(): the same bits whatever the workers and chunks; a failed orbit is a row; what is kept of each."""

import threading

import numpy as np
import pytest

import sympflow
from sympflow import workers
from sympflow.ensembles import chunks, reductions, sweep

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
@pytest.mark.parametrize("engine", [1, 2, map])
def test_the_same_bits_whatever_the_workers_and_chunks(engine, chunk):
    reference = sympflow.solve(SYSTEM, "verlet", SPAN, STATES, dt=DT, t_eval=[SPAN[1]]).y[..., 0]
    assert np.array_equal(kept(reduce="final", workers=engine, chunk=chunk).final, reference)


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


def test_no_orbit_is_asked_when_its_solution_becomes_infinite(monkeypatch):
    monkeypatch.setattr("sympflow.integrators.diagnosis.note_singularities", lambda *_: 1 / 0)
    states = np.array([STATES[0], [60.0, 60.0, 0.0, 0.0]])
    result = sympflow.ensemble(SYSTEM, "verlet", SPAN, states, dt=DT, reduce="final")
    assert result.status.tolist() == [0, -1]
    with pytest.raises(ZeroDivisionError):
        sympflow.solve(SYSTEM, "verlet", SPAN, states, dt=DT)
    assert sympflow.solve(SYSTEM, "verlet", SPAN, states, dt=DT, diagnose=False).status.tolist() == [0, -1]
    with pytest.raises(TypeError, match="`diagnose` must be True or False"):
        sympflow.solve(SYSTEM, "verlet", SPAN, states, dt=DT, diagnose=2)


def test_a_users_function():
    result = kept(reduce=lambda t, y: {"largest": y[0].max(), "ends": y[:, [0, -1]]}, chunk=50)
    states = kept().y
    assert np.array_equal(result.largest, states[:, 0].max(axis=-1))
    assert np.array_equal(result.ends, states[..., [0, -1]])
    errors = kept(reduce="energy_error").energy_error
    H = SYSTEM.hamiltonian(states.swapaxes(1, 2))
    assert np.allclose(errors, np.abs(H / H[:, :1] - 1).max(1), rtol=1e-9)


@pytest.mark.slow
def test_a_grid_of_parameters():
    H = "p**2/(2*m) + k*q**2/2 + a*q**4/4 - F*a*q"  # F a is a product of parameters that is added
    system = sympflow.HamiltonianSystem.from_sympy(H, params={"k": 1.0, "a": 0.1, "m": 1.3, "F": 0.37})
    k, states = [1.0, 2.0, 4.0], np.array([[1.0, 0.0], [0.5, 0.2]])

    def swept(**how):
        return sympflow.ensemble(system, "verlet", (0, 2), states, dt=0.1, params={"k": k, "a": [0.0, 0.3]}, **how)

    result = swept(reduce="final")
    assert result.final.shape == (3, 2, 2, 2)
    assert list(result.params) == ["k", "a"]
    assert result.to_xarray().q.dims == ("k", "a", "orbit", "dof")
    assert result.to_xarray().attrs["dt"] == 0.1
    for chunk in (1, 5):  # of one value of the parameters, or of several
        assert np.array_equal(swept(reduce="final", chunk=chunk, workers=2).final, result.final)
    for i, value in enumerate(k):
        changed = system.with_params(k=value, a=0.3)
        expected = sympflow.solve(changed, "verlet", (0, 2), states, dt=0.1)
        assert np.array_equal(result.final[i, 1], expected.y[..., -1])
        H = changed.hamiltonian(expected.states)
        worst = np.abs(H / H[:, :1] - 1).max(1)
        assert np.allclose(swept(reduce="energy_error").energy_error[i, 1], worst, atol=1e-13)
    fixed = sympflow.ensemble(system, "verlet", (0, 2), states, dt=0.1, params={"k": 2.0}, reduce="final")
    assert fixed.final.shape == (2, 2)


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [
        (
            {"params": {"lam": [1.0]}},
            ValueError,
            "`params` has 'lam', which is not a parameter of 'henon_heiles', which has none",
        ),
        ({"params": 3}, TypeError, "`params` must map names"),
        ({"workers": 0}, ValueError, "`workers` must be a positive number"),
        ({"reduce": lambda t, y: {"messages": 1.0}}, ValueError, "returns 'messages', a name that the result has"),
        ({"reduce": lambda t, y: {"t": 1.0}}, ValueError, "returns 't', a name that the result has already"),
        ({"reduce": "finall"}, ValueError, "Did you mean 'final'"),
        ({"reduce": 3}, TypeError, "`reduce` must be a name"),
        ({"reduce": lambda t, y: 1 / 0}, ValueError, "`reduce` raises ZeroDivisionError: division by zero"),
        ({"reduce": lambda t, y: "text"}, TypeError, "`reduce` must return numbers"),
        ({"reduce": lambda t, y: 2**53 + 1}, ValueError, r"`reduce` cannot be kept: reduced has an integer"),
        ({"reduce": lambda t, y: {"a": [1, -(2**70)]}}, ValueError, "`reduce` cannot be kept: a has an integer beyond"),
        ({"reduce": lambda t, y: {"status": 1.0}}, ValueError, "`reduce` returns 'status', a name that"),
        ({"workers": "two"}, TypeError, "`workers` must be a number"),
        ({"backend": "gpu"}, ValueError, "`backend` must be one of 'auto'"),
        ({"backend": "cuda"}, ValueError, "`backend` must be one of .*: for a GPU pass tensors on it"),
        ({"chunk": 0}, ValueError, "`chunk` must be a positive integer"),
        ({"n": 3}, ValueError, "`n` is for drawing states"),
        ({"seed": -1}, ValueError, "`seed` must be an integer"),
        ({"progress": 3}, TypeError, "`progress` must be True, False"),
        ({"y0": SYSTEM.domain}, ValueError, "`n` is needed"),
        ({"y0": SYSTEM.domain, "n": 10**8}, ValueError, r"`store` is needed: 204 numbers of each of 100,000,000"),
        ({"y0": SYSTEM.domain, "n": 10**8, "chunk": 1, "reduce": "final"}, ValueError, "`chunk` of 1 cuts"),
        ({"method": "dop853"}, ValueError, "`t_eval` is needed: each orbit has steps of its own"),
    ],
)
def test_bad_input(how, error, message):
    given = {"method": "verlet", "y0": STATES, "t_span": SPAN, "dt": DT} | how
    if given["method"] != "verlet":
        del given["dt"]
    with pytest.raises(error, match=message):
        sympflow.ensemble(SYSTEM, **given)


def test_a_function_that_fails_later_fails_a_row():
    def strict(t, y):
        if y[0, 0] == STATES[7, 0]:
            raise RuntimeError("not this one")
        return np.zeros(3 if y[0, 0] == STATES[9, 0] else 2)

    result = kept(reduce=strict, chunk=20)
    assert np.flatnonzero(result.status).tolist() == [7, 9]
    assert "RuntimeError: not this one" in result.messages[7,]
    assert "returns reduced of shape (3,), but reduced of shape (2,) for the first" in result.messages[9,]
    assert np.isnan(result.reduced[7]).all()


def test_numbers_of_a_function_are_kept_or_the_row_fails():
    def kinds(t, y):
        one = y[0, 0] == STATES[3, 0]
        huge = y[0, 0] == STATES[4, 0]
        return {"real": 1j if one else 1 + 0j * t[0], "complex": complex(0, 1), "whole": 2**63 if huge else 2**53}

    def real_first(t, y):
        return {name: v.real if name == "real" and v == 1 else v for name, v in kinds(t, y).items()}

    result = kept(reduce=real_first)
    assert np.flatnonzero(result.status).tolist() == [3, 4]
    assert "returns complex real, and real ones for the first orbit" in result.messages[3,]
    assert "whole has an integer beyond 2**53" in result.messages[4,]
    assert (result.complex[result.status == 0] == 1j).all()
    assert (result.whole[result.status == 0] == 2**53).all()
    assert kept(reduce=kinds).real[3] == 1j


def test_progress():
    told = []
    kept(reduce="final", chunk=50, progress=lambda done, total: told.append((done, total)))
    assert told == [(0, 200), (50, 200), (100, 200), (150, 200), (200, 200)]


def test_masked_values_of_a_reduction_are_missing():
    found = kept(reduce=lambda t, y: {"a": np.ma.array([1.0, 2.0], mask=[False, True]), "b": np.ma.array([3, 4])})
    assert (found.a[:, 0] == 1).all()
    assert np.isnan(found.a[:, 1]).all()
    assert (found.b == [3, 4]).all()


def test_what_is_sent_to_processes_is_small_and_can_be_sent():
    task = sweep.Task(SYSTEM, sympflow.get("verlet")(dt=DT), SPAN, None, {}, reductions.States(), "auto")
    assert len(workers.PickledTask(task).pack()) < 20_000
    lock = threading.Lock()
    with pytest.raises(TypeError, match="`reduce` cannot be sent to the processes of `workers`"):
        kept(reduce=lambda t, y: float(lock.locked()), workers=2)


def test_values_without_a_system_fail_their_orbits():
    system = sympflow.HamiltonianSystem.from_sympy("p**2/(2*m) + q**2/2", params={"m": 1.0})
    for values, message in (([1.0, np.nan], "m = nan at 1"), ([[1.0]], r"a list of them; got shape \(1, 1\)")):
        with pytest.raises(ValueError, match=f"`params` .*{message}"):
            sympflow.ensemble(system, "verlet", (0, 1), [1.0, 0.0], params={"m": values}, dt=0.1)
    for backend in ("auto", "array"):
        how = {"params": {"m": [2.0, 0.0, 3.0]}, "dt": 0.1, "reduce": "final", "backend": backend}
        result = sympflow.ensemble(system, "verlet", (0, 1), [[1.0, 0.0], [0.0, 1.0]], **how)
        assert result.status.tolist() == [[0, 0], [-1, -1], [0, 0]]
        assert "m = 0" in result.messages[1, 1]
        assert np.isfinite(result.final).all(axis=-1).tolist() == (result.status == 0).tolist()


@pytest.mark.parametrize("method", ["verlet", "implicit_midpoint"])
def test_windows_are_pieces_of_the_run(method, monkeypatch):
    states = STATES[:10].copy()
    states[3] = 60.0

    def chunk():
        return chunks.Chunk(SYSTEM, sympflow.get(method)(dt=DT), (0, 5.03), None, states)

    whole = chunk()
    expected = whole.states(whole.times)
    monkeypatch.setattr(chunks, "MOST_VALUES", 20 * states.size)
    cut = chunk()
    windows = list(cut.windows())
    assert [len(t) for t, _ in windows] == [20, 20, 11, 1]
    assert np.array_equal(np.concatenate([t for t, _ in windows]), whole.times)
    assert np.array_equal(np.concatenate([y for _, y in windows], axis=-1), expected, equal_nan=True)
    assert cut.messages == whole.messages
    assert cut.status.tolist() == whole.status.tolist()


def test_states_are_drawn_alike_in_any_chunks():
    def drawn(y0, chunk):
        return sympflow.ensemble(SYSTEM, "verlet", (0, 1), y0, n=5000, seed=3, chunk=chunk, reduce="final", dt=DT).final

    for y0 in (SYSTEM.domain, lambda rng, n: 0.1 * rng.standard_normal((n, 4))):
        assert np.array_equal(drawn(y0, 5000), drawn(y0, 999))


@pytest.mark.parametrize(("method", "options"), [("verlet", {"backend": "array"}), ("dop853", {})])
def test_the_same_bits_where_python_runs(method, options):
    def final(chunk):
        return sympflow.ensemble(SYSTEM, method, (0, 1), STATES[:80], reduce="final", chunk=chunk, **options).final

    reference = final(80)
    for chunk in (1, 7, 64):
        assert np.array_equal(final(chunk), reference)


def test_energy_errors_where_some_values_drive_the_system():
    H = "p**2/2 + q**2/2 - (a - b)*q*cos(t)"
    system = sympflow.HamiltonianSystem.from_sympy(H, time="t", params={"a": 0.3, "b": 0.0})

    def swept(**params):
        how = {"params": params, "dt": 0.1, "reduce": "energy_error", "backend": "array"}
        return sympflow.ensemble(system, "verlet", (0, 1), [[1.0, 0.0], [0.0, 1.0]], **how)

    for values in ([0.0, 0.1], [0.1, 0.0]):
        with pytest.raises(ValueError, match=r"`system` .* is driven, H depends on t, so its energy is not conserved"):
            swept(a=values)
    result = swept(a=[0.3, 0.2], b=[0.3])
    assert result.status.tolist() == [[[0, 0]], [[-1, -1]]]
    assert "`params` has a = 0.2, b = 0.3: `system`" in result.messages[1, 0, 1]
    assert np.isfinite(result.energy_error).all(axis=(1, 2)).tolist() == [True, False]
