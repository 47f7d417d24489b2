"""A call imports nothing that it does not need. Each case runs in a fresh interpreter."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "scipy", "matplotlib", "numba", "sympy", "torchdiffeq", "safetensors")


def loaded_after(code: str) -> set[str]:
    script = f"{code}\nimport sys\nprint('loaded:', *(m for m in {HEAVY} if m in sys.modules))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(result.stdout.rpartition("loaded:")[2].split())


def test_importing_the_package_loads_nothing_heavy():
    assert loaded_after("import sympflow; sympflow.__version__; dir(sympflow)") == set()


def test_systems_need_sympy_only():
    assert loaded_after("import sympflow; sympflow.systems.henon_heiles().force") == {"sympy"}


@pytest.mark.parametrize("backend", ["array", "auto"])
def test_a_verlet_solve_loads_sympy_only(backend):
    code = (
        "import sympflow\n"
        f"sol = sympflow.solve(sympflow.systems.henon_heiles(), 'verlet', (0, 1), backend={backend!r})\n"
        "sol.energy(); sympflow.available()"
    )
    assert loaded_after(code) == {"sympy"}


def test_traced_functions_of_numpy_load_nothing_heavy():
    code = (
        "import sympflow\nimport numpy as np\n"
        "system = sympflow.HamiltonianSystem(lambda q: np.cos(q).sum(-1), ndof=2, y0=[0.1, 0.2, 0.3, 0.4])\n"
        "for method in ('verlet', 'srkn11b', 'gauss_legendre4', 'rk4'):\n"
        "    assert sympflow.solve(system, method, (0, 1), dt=0.1).stats['backend'] == 'compiled'"
    )
    assert loaded_after(code) == set()


@pytest.mark.parametrize(
    "code",
    [
        "sympflow.lyapunov(sympflow.systems.henon_heiles(), 'verlet', (0, 1), dt=0.1, backend='compiled')",
        "sympflow.volume_error(sympflow.solve(sympflow.systems.henon_heiles(), 'srkn11b', (0, 1), dt=0.1))",
        "H = ' + '.join(f'p{i}**2/2 + cos(q{i}) + (q{i} - q{i + 1})**4/4' for i in range(1, 150)) + ' + p150**2'\n"
        "system = sympflow.HamiltonianSystem.from_sympy(H, y0=[0.1]*300)\n"
        "assert sympflow.solve(system, 'verlet', (0, 1), dt=0.1).stats['backend'] == 'compiled'",
        "for method in ('gauss_legendre4', 'strang_parts', 'log_kahan_li8', 'rk4', 'tao4'):\n"
        "    sol = sympflow.solve(sympflow.systems.kepler(), method, (0, 1), dt=0.1)\n"
        "    assert sol.stats['backend'] == 'compiled', method",
        "sol = sympflow.solve(sympflow.systems.lennard_jones(), 'verlet', (0, 0.001))\n"
        "assert sol.stats['backend'] == 'compiled'",
        "sympflow.ensemble(sympflow.systems.pendulum(), 'verlet', (0, 1), [[1.0, 0.0]] * 100)",
    ],
    ids=["deviation vectors", "volume", "many terms", "kinds", "pairs", "ensemble"],
)
def test_compiled_runs_load_no_numba(code):
    assert not {"numba", "torch"} & loaded_after(f"import sympflow\n{code}")


@pytest.mark.parametrize("scene", ["henon_heiles", "harmonic_oscillator"])
def test_runs_of_primed_flows_and_networks_load_no_numba(scene):
    code = f"import sympflow\nsympflow.solve(sympflow.systems.{scene}(), 'sympflow', (0, 10))"
    assert "numba" not in loaded_after(code)


@pytest.mark.parametrize("scene", ["henon_heiles", "pendulum", "fput_beta", "driven_pendulum", "harmonic_oscillator"])
def test_a_flow_that_ships_loads_no_torch(scene):
    code = (
        "import sympflow\n"
        f"sol = sympflow.solve(sympflow.systems.{scene}(), 'sympflow', (0, 10))\n"
        "assert sol.success and sol.stats['backend'] == 'compiled'"
    )
    assert "torch" not in loaded_after(code)


def test_scipy_methods_load_no_torch():
    code = "import sympflow\nsympflow.solve(sympflow.systems.pendulum(), 'rk45', (0, 1))"
    assert loaded_after(code) == {"sympy", "scipy"}


def test_energy_metrics_load_no_torch():
    code = (
        "import sympflow\n"
        "sol = sympflow.solve(sympflow.systems.pendulum(), 'verlet', (0, 1), backend='array')\n"
        "sympflow.max_energy_error(sol); sympflow.volume_error(sol)"
    )
    assert "torch" not in loaded_after(code)


def test_unknown_attributes_are_attribute_errors():
    import sympflow

    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        sympflow.nonsense  # noqa: B018
