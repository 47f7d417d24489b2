"""A call imports nothing that it does not need, as fresh interpreters show."""

import ast
import subprocess
import sys

import pytest

HEAVY = ("torch", "scipy", "numpy.f2py", "matplotlib", "numba", "sympy", "torchdiffeq", "safetensors")
FLOWS = ("henon_heiles", "pendulum", "fput_beta", "driven_pendulum", "harmonic_oscillator")

ALLOWED = [
    "import sympflow; sympflow.__version__; dir(sympflow)",
    "import numpy as np, sympflow\n"
    "system = sympflow.HamiltonianSystem(lambda q: np.cos(q).sum(-1), ndof=2, y0=[0.1, 0.2, 0.3, 0.4])\n"
    "for method in ('verlet', 'srkn11b', 'gauss_legendre4', 'rk4'):\n"
    "    assert sympflow.solve(system, method, (0, 1), dt=0.1).stats['backend'] == 'compiled'",
    "import sympflow\n"
    "for H in 'p**2/2 + q**2/2 + q**4/4', 'p**2/2 + exp(-2*q) - 2*exp(-q)', 'p**2/2 - cos(q)/3 + sqrt(1 + q**2)':\n"
    "    system = sympflow.HamiltonianSystem.from_sympy(H, y0=[0.5, 0.0])\n"
    "    assert sympflow.solve(system, 'verlet', (0, 1), dt=0.1).stats['backend'] == 'compiled'\n"
    "for H, params in ('p**2/(2*m) + k*q**2/2 - g*cos(q)', dict(m=2.0, k=0.5, g=0.3)), "
    "('p**2/2 + k/q + q**2', dict(k=1.5)):\n"
    "    system = sympflow.HamiltonianSystem.from_sympy(H, params=params, y0=[0.5, 0.0])\n"
    "    for of in system, system.with_params(k=0.7):\n"
    "        assert sympflow.solve(of, 'verlet', (0, 0.1), dt=0.01).stats['backend'] == 'compiled'\n"
    "    sol = sympflow.solve(system, 'verlet', (0, 0.1), params={'k': [0.4, 1.0]}, dt=0.01)\n"
    "    assert sol.energy().shape == (2, 11)\n"
    "for scene in sympflow.systems.pendulum, sympflow.systems.kepler, sympflow.systems.driven_pendulum:\n"
    "    for method in 'srkn11b', 'gauss_legendre4', 'rk4', 'verlet':\n"
    "        assert sympflow.solve(scene(), method, (0, 1), dt=0.1).stats['backend'] == 'compiled'\n"
    "    sympflow.solve(scene(), 'verlet', (0, 1), backend='array').energy()\n"
    "    assert scene().hessian(scene().y0, 0.0) is not None",
    "for scene in 'pendulum', 'kepler', 'henon_heiles', 'driven_pendulum':\n"
    "    assert sympflow.solve(scene, 'sympflow', (0, 10)).stats['backend'] == 'compiled'",
    "import sympflow; sympflow.systems.henon_heiles().expression",
    "import sympflow\nsympflow.available(); sympflow.shipped_flows()",
    "import sympflow; sympflow.solve(sympflow.systems.pendulum(), 'rk45', (0, 1))",
]
"""Code that needs NumPy alone; flows need the reader of their weights too, `expression` SymPy, the last one SciPy."""

COMPILED = [
    "sympflow.lyapunov(sympflow.systems.henon_heiles(), 'verlet', (0, 1), dt=0.1, backend='compiled')",
    "sympflow.volume_error(sympflow.solve(sympflow.systems.henon_heiles(), 'srkn11b', (0, 1), dt=0.1))",
    "sol = sympflow.solve(sympflow.systems.pendulum(), 'verlet', (0, 1), backend='array')\n"
    "sympflow.max_energy_error(sol); sympflow.volume_error(sol)",
    "H = ' + '.join(f'p{i}**2/2 + cos(q{i}) + (q{i} - q{i + 1})**4/4' for i in range(1, 150)) + ' + p150**2'\n"
    "system = sympflow.HamiltonianSystem.from_sympy(H, y0=[0.1]*300)\n"
    "assert sympflow.solve(system, 'verlet', (0, 1), dt=0.1).stats['backend'] == 'compiled'",
    "for method in ('gauss_legendre4', 'strang_parts', 'log_kahan_li8', 'rk4', 'tao4'):\n"
    "    sol = sympflow.solve(sympflow.systems.kepler(), method, (0, 1), dt=0.1)\n"
    "    assert sol.stats['backend'] == 'compiled', method",
    "sol = sympflow.solve(sympflow.systems.lennard_jones(), 'verlet', (0, 0.001))\n"
    "assert sol.stats['backend'] == 'compiled'",
    "sympflow.ensemble(sympflow.systems.pendulum(), 'verlet', (0, 1), [[1.0, 0.0]] * 100)",
    *(
        f"sol = sympflow.solve(sympflow.systems.{scene}(), 'sympflow', (0, 10))\n"
        "assert sol.success and sol.stats['backend'] == 'compiled'"
        for scene in FLOWS
    ),
]


def loaded_after(*codes: str) -> dict[str, str]:
    """Heavy packages → the first of these pieces of code, run by one interpreter, after which they are in memory."""
    script = "import sys\nloaded = {}\n" + "".join(
        f"{code}\nfor m in {HEAVY}:\n    if m in sys.modules: loaded.setdefault(m, {code!r})\n" for code in codes
    )
    result = subprocess.run(
        [sys.executable, "-c", f"{script}\nprint('loaded:', loaded)"], capture_output=True, text=True, check=True
    )
    return ast.literal_eval(result.stdout.rpartition("loaded:")[2])


def test_a_call_loads_what_it_needs():
    loaded = loaded_after(*ALLOWED)
    assert loaded == {
        "safetensors": ALLOWED[3],
        "sympy": ALLOWED[4],
        "scipy": ALLOWED[-1],
        "numpy.f2py": ALLOWED[-1],
    }  # by SciPy


def test_neither_compiled_runs_nor_flows_that_ship_load_numba_or_torch():
    loaded = loaded_after("import sympflow", *COMPILED)
    assert not {"numba", "torch"} & loaded.keys(), loaded


def test_unknown_attributes_are_attribute_errors():
    import sympflow

    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        sympflow.nonsense  # noqa: B018
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        sympflow.interop.nonsense  # noqa: B018
