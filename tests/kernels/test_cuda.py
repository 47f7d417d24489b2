"""The loops for a GPU: run in Numba's simulator, compiled for the device as far as that goes without one."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from numba import types

import sympflow
from sympflow.kernels.cuda_loops import cuda_module

SYSTEM = sympflow.systems.henon_heiles()
STATES = SYSTEM.domain.sample(3, 0)

SIMULATED = """
import pickle, warnings
import numpy as np
import sympflow
from sympflow.integrators.registry import get
from sympflow.kernels.carry import Carry
from sympflow.kernels.cuda_loops import cuda_kernel

warnings.simplefilter("ignore")  # of NumPy, by which the simulator computes
system = sympflow.systems.henon_heiles()
states = system.domain.sample(3, 0)

def both(system, method, y0, other="array", **how):
    sol = sympflow.solve(system, method, (0, 2), y0, backend="cuda", **how)
    expected = sympflow.solve(system, method, (0, 2), y0, backend=other, **how | {"compensated": False})
    assert sol.stats["backend"] == "cuda"
    assert np.array_equal(sol.status, expected.status)
    assert np.allclose(sol.y, expected.y, rtol=1e-9, atol=1e-14, equal_nan=True)
    if other == "auto":
        assert expected.stats["backend"] == "compiled"
        assert sol.stats["force_evaluations"] == expected.stats["force_evaluations"]
    return sol

for method, dt in (("chin4a", 0.25), ("srkn14a", 0.5)):
    sol = both(system, method, states, dt=dt)
assert np.abs(sol.energy_error()).max() < 1e-6
both(system, "kahan_li8", states, "auto", dt=0.5)
both(system, "verlet", states[0], dt=0.1, save_every=7)
both(system, "verlet", states, dt=0.1, t_eval=[0.0, 0.33, 2.0], compensated=True)
dense = both(system, "verlet", states[:2], dt=0.1, dense_output=True)
assert np.array_equal(pickle.loads(pickle.dumps(dense)).sol(0.33), dense.sol(0.33))
far = both(system, "verlet", np.array([states[0], [60.0, 60.0, 0.0, 0.0], states[1]]), "auto", dt=0.1)
assert far.status.tolist() == [0, -1, 0]

own = sympflow.HamiltonianSystem.from_sympy("p**2/2 + k*q**2/2 - a*cos(q)", params={"k": 1.3, "a": 0.2}, dt=0.1)
for method in ("verlet", "chin4a"):
    both(own, method, np.array([[1.0, 0.0], [0.3, 0.1]]), params={"k": [1.1, 2.2]})
both(own, "verlet", np.array([1.0, 0.0]), params={"k": [[1.1, 2.2], [3.3, 1.0]]})

how = {"y0": [[1.0, 0.0], [0.3, 0.1]], "params": {"k": [1.1, 2.2]}, "chunk": 3}
ways = ({"backend": "cuda"}, {"backend": "cuda", "workers": 2}, {"backend": "array"})
swept = [sympflow.ensemble(own, "verlet", (0, 1), **how, **way) for way in ways]
assert np.allclose(swept[0].y, swept[2].y, rtol=0, atol=1e-14)
assert np.array_equal(swept[0].y, swept[1].y)
assert np.array_equal(swept[1].status, np.zeros((2, 2)))

kernel = cuda_kernel(system, get("verlet").scheme, True)
whole = kernel.run_batch(0.1, states, 9, np.array([4, 9]))
carry = Carry()
pieces = [kernel.run_batch(0.1, states, n, np.array([n]), carry=carry).states for n in (4, 9)]
assert np.array_equal(np.concatenate(pieces, axis=1), whole.states)
carry = Carry()
pieces = [kernel.run(0.1, states[0], n, np.array([n]), carry=carry).states for n in (4, 9)]
assert np.array_equal(np.concatenate(pieces), whole.states[0])
print("all agree")
"""


def test_the_simulator_agrees_with_other_backends():
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}
    run = subprocess.run(
        [sys.executable, "-c", SIMULATED], check=False, capture_output=True, text=True, env=environment, timeout=300
    )
    assert run.stdout.strip() == "all agree", run.stderr


@pytest.mark.parametrize("compensated", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_loops_compile_for_a_device(monkeypatch, compensated):
    """To LLVM's code for it: what the simulator runs as Python may have no meaning there."""
    dispatcher = pytest.importorskip("numba.cuda.dispatcher")
    compiler = pytest.importorskip("numba.cuda.compiler")
    monkeypatch.setattr(dispatcher, "get_current_device", lambda: SimpleNamespace(compute_capability=(8, 0)))
    two, three = (types.Array(types.float64, n, "C") for n in (2, 3))
    counts, n = types.Array(types.int64, 1, "C"), types.int64
    arguments = (three, two, n, counts, three, counts, counts, n, two)
    loops = cuda_module(SYSTEM.symbols, 2 if compensated else 0, (), compensated)
    made = compiler.compile_cuda(loops.rollout_orbits.py_func, types.void, arguments, cc=(8, 0))
    assert made.signature.return_type == types.void


def by_functions():
    return sympflow.HamiltonianSystem(potential=lambda q: (q**2).sum(-1) / 2, ndof=2)


@pytest.mark.parametrize(
    ("system", "method", "options", "message"),
    [
        (SYSTEM, "verlet", {}, "`backend` 'cuda' does not apply. Numba finds no NVIDIA GPU with its driver: use"),
        (SYSTEM, "gauss_legendre4", {}, "`backend` 'cuda' is for splitting methods on the splitting 'kinetic'"),
        (SYSTEM, "verlet", {"clock": "logarithmic"}, "'verlet \\(logarithmic\\)' is none: use backend='auto'"),
        (SYSTEM, "sympflow", {}, "'sympflow' is none"),
        (SYSTEM, "verlet", {"dtype": "float32"}, "`backend` 'cuda' does not apply. `y0` is float32"),
        (by_functions(), "verlet", {}, "`system` 'custom' is not symbolic: define it"),
        (
            sympflow.HamiltonianSystem.from_sympy("(p1**2 + p2**2 + q1**2 + q2**2)/2", damping=0.1),
            "verlet",
            {},
            "`system` 'custom' has friction; or use backend='auto'",
        ),
        (
            sympflow.HamiltonianSystem.from_sympy("(p1**2 + p2**2 + q1**2 + q2**2)/2 + q1*cos(t)", time="t"),
            "verlet",
            {},
            "`system` 'custom' has an H that depends on t",
        ),
    ],
)
def test_what_no_gpu_runs_is_refused(system, method, options, message):
    if "NVIDIA" in message:
        from numba import cuda

        if cuda.is_available():
            pytest.skip("there is a GPU")
    with pytest.raises(ValueError, match=message):
        sympflow.solve(system, method, (0, 1), STATES, backend="cuda", **options)
    with pytest.raises(ValueError, match="`backend` must be one of 'auto', 'compiled', 'array', 'cuda'; got 'gpu'"):
        sympflow.solve(system, method, (0, 1), STATES, backend="gpu")
