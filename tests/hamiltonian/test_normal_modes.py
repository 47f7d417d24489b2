"""Normal modes by fast transforms: exact linear flows of lattices and of complex fields."""

import math
import pickle

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, get, solve, symplecticity_defect, systems
from sympflow.hamiltonian.linear_part import Transform
from sympflow.hamiltonian.parts import exact_parts

RNG = np.random.default_rng(7)
LATTICES = {
    "disordered ring": {
        "onsite": "c*q**2/2 + q**4/4",
        "bond": {1: "r**2/2 + r**3/3", 2: "b*r**2"},
        "shape": (9,),
        "params": {"c": RNG.random(9), "b": 0.3},
    },
    "fixed": {"onsite": "q**4/4", "bond": {1: "2*r**2", 2: "r**2/8"}, "boundary": "fixed", "shape": (8,)},
    "free wells": {"onsite": "(q**2 - 1)**2/4", "bond": "2*r**2", "boundary": "free", "shape": (7,)},
    "two fields": {
        "onsite": "u*v + v**2 + u**2*v**2",
        "bond": "r_u**2 + r_v**2/2",
        "fields": ("u", "v"),
        "kinetic": "p_u**2/2 + p_v**2/6",
        "boundary": ("free", "periodic"),
        "shape": (3, 4),
    },
}


@pytest.mark.parametrize("boundary", ["periodic", "fixed", "free"])
@pytest.mark.parametrize("shape", [(1,), (2,), (7,), (8,), (4, 5, 3)])
def test_a_transform_is_orthonormal_on_arrays_and_tensors(shape, boundary):
    W = Transform(shape, (boundary,) * len(shape))
    x, y = RNG.normal(size=(2, 3, *shape))
    sites = tuple(range(1, 1 + len(shape)))
    np.testing.assert_allclose((W.forth(x) * W.forth(y)).sum(sites), (x * y).sum(sites), atol=1e-13)
    np.testing.assert_allclose(W.back(W.forth(x)), x, atol=1e-14)
    np.testing.assert_allclose(W.forth(torch.tensor(x)), W.forth(x), atol=1e-14)
    np.testing.assert_allclose(W.back(torch.tensor(x)), W.back(x), atol=1e-14)


@pytest.mark.parametrize("name", LATTICES)
def test_the_linear_part_of_a_lattice(name):
    """H is it and the rest; its modes are symplectic; on the linear part alone one long step is exact."""
    system = HamiltonianSystem.lattice(**LATTICES[name])
    parts, d = exact_parts(system), system.ndof
    y = np.random.default_rng(1).normal(scale=0.3, size=(3, 2 * d))
    X, Y = parts.to_modes(y)
    np.testing.assert_allclose(parts.from_modes(X, Y), y, atol=1e-13)
    np.testing.assert_allclose(parts.C @ parts.inverse_C, np.eye(d), atol=1e-13)
    energy = parts.linear_energies(X, Y).sum(-1) + parts.value(1, X, Y, None)
    assert np.ptp(energy - system.hamiltonian(y)) < 1e-13
    end = solve(system, "linear_kahan_li8", (0, 1), y[0], dt=1 / 64, t_eval=[1.0]).y[:, -1]
    kinetic = solve(system, "kahan_li8", (0, 1), y[0], dt=1 / 64, t_eval=[1.0], backend="array").y[:, -1]
    np.testing.assert_allclose(end, kinetic, atol=1e-11)
    for method, order in (("impulse", 2), ("linear_omelyan4", 4)):
        errors = [
            abs(solve(system, method, (0, 1), y[0], dt=h, t_eval=[1.0]).y[:, -1] - end).max() for h in (0.1, 0.05)
        ]
        assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)
    sol = solve(system, "linear_srkn6b", (0, 1), torch.tensor(y), dt=0.1)
    np.testing.assert_allclose(sol.y, solve(system, "linear_srkn6b", (0, 1), y, dt=0.1).y, atol=1e-13)


def test_one_step_of_a_linear_wave_equation_is_exact_however_long():
    for boundary in ("periodic", "fixed", "free"):
        chain = HamiltonianSystem.lattice(bond="50*r**2", onsite="q**2/8", boundary=boundary, shape=64)
        y0 = RNG.normal(size=128)
        short, long = (solve(chain, "impulse", (0, 40.0), y0, dt=h, t_eval=[40.0]).y[:, -1] for h in (0.25, 40.0))
        np.testing.assert_allclose(short, long, atol=1e-11)
        (K,) = (chain.potential_hessian(np.zeros(64)),)
        np.testing.assert_allclose(np.sort(chain.linear_part.frequencies), np.sqrt(np.linalg.eigvalsh(K)), atol=1e-12)


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        ({"bond": "r**2", "kinetic": "p**2/(2*m)", "params": {"m": np.arange(1.0, 6.0)}}, "`kinetic` must be"),
        ({"bond": "r**2", "kinetic": "p**4"}, "`kinetic` must be"),
        ({"bond": "r**4", "onsite": "1 - cos(q)"}, "`onsite` and `bond` have no quadratic terms"),
    ],
)
def test_lattices_without_known_modes_are_refused(definition, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        get("impulse")().composed(HamiltonianSystem.lattice(**definition, shape=5))
    with pytest.raises(ValueError, match="made of pairs"):
        _ = HamiltonianSystem.pairs("-m1*m2/r", masses=[1.0, 1.0]).linear_part


# complex fields ------------------------------------------------------------------------------------------------------

SOLITON = systems.nonlinear_schroedinger(n=256, length=60.0)
TRAP = HamiltonianSystem.schroedinger(
    "V*rho + g*rho**2/2",
    shape=(4, 6),
    length=(4.0, 5.0),
    params={"V": RNG.random((4, 6)), "g": 0.7, "J": 0.5},
    dispersion="J*(1 - cos(k)) + k**2/8",
)


def test_derivatives_of_a_complex_field_are_those_of_H():
    y = torch.tensor(RNG.normal(size=(2, 48)))
    gradient = torch.func.vmap(torch.func.grad(TRAP.hamiltonian))(y)
    hessian = torch.func.vmap(torch.func.hessian(TRAP.hamiltonian))(y)
    for array in (y, y.numpy()):
        np.testing.assert_allclose(TRAP.gradient(array), gradient, atol=1e-13)
        np.testing.assert_allclose(TRAP.hessian(array), hessian, atol=1e-13)
    np.testing.assert_allclose(TRAP.energy_density(y).sum((-1, -2)), TRAP.hamiltonian(y.numpy()), rtol=1e-13)
    again = pickle.loads(pickle.dumps(TRAP)).with_params(g=0.0)
    assert again.params["g"] == 0.0
    assert TRAP.params["g"] == 0.7
    with pytest.raises(ValueError, match="use a method with the exact linear flow, such as 'impulse'"):
        solve(TRAP, "verlet", (0, 1), np.ones(48), dt=0.1)


def test_the_soliton_solves_the_equation_and_has_its_norm_and_energy():
    h, y = 60 / 256, SOLITON.exact(np.array([0.0, 5.0]))
    np.testing.assert_allclose(h * (y**2).sum(-1) / 2, 2.0, rtol=1e-9)
    np.testing.assert_allclose(h * SOLITON.hamiltonian(y), 0.25 - 1 / 3, rtol=1e-8)
    step = 1e-3
    e = SOLITON.exact(5.0 + step * np.array([-2, -1, 1, 2]))
    np.testing.assert_allclose((e[0] - 8 * e[1] + 8 * e[2] - e[3]) / (12 * step), SOLITON.vector_field(y[1]), atol=1e-8)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"onsite": "q**2"}, "`onsite` holds q"),
        ({"dispersion": "1/k**2"}, "`dispersion` must be finite"),
        ({"dispersion": "k**2 + sin(k)"}, r"`dispersion` k\*\*2 \+ sin\(k\) must be an even function"),
        ({"dispersion": "V*k"}, "`dispersion` holds V"),
        ({"length": -1.0}, "`length` must be positive"),
        ({"length": (1.0, 2.0)}, "`length` must be positive"),
        ({"shape": (10**6, 10**6)}, "`shape` has 1e.12 degrees"),
        ({"params": {"rho": 1.0}}, "`params` gives a value to 'rho'"),
        ({"params": {"a": 1.0}}, "`params` has 'a', which no expression uses"),
    ],
)
def test_bad_complex_fields_are_refused(changed, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        HamiltonianSystem.schroedinger(**{"shape": 8, **changed})


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("linear_srkn11b", "`method` 'linear_srkn11b' has a Nyström scheme"),
        ("linear_omelyan4", "`method` 'linear_omelyan4' "),
        ("mollified_impulse", "`splitting` 'mollified'"),
        ("verlet", "`method` 'verlet' needs a separable system"),
    ],
)
def test_methods_for_potentials_refuse_a_complex_field(method, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        solve(TRAP, method, (0, 1), np.ones(48), dt=0.1)


def test_angles_of_more_than_a_half_turn():
    """A single site, where the solution is known: ψ e^{−i(ω + f')t}."""
    one = HamiltonianSystem.schroedinger("rho**2", shape=1, dispersion="2")
    for s in (0.4, 1.9, 3.2, -7.0, 40.0):
        q, p = solve(one, "impulse", (0, s), [1.2, -0.9], dt=abs(s), t_eval=[s]).y[:, -1]
        rho = (1.2**2 + 0.9**2) / 2
        assert q + 1j * p == pytest.approx((1.2 - 0.9j) * np.exp(-1j * (2 + 2 * rho) * s), abs=1e-13)


@pytest.mark.parametrize(
    ("method", "order"), [("impulse", 2), ("linear_blanes_moan4", 4), ("linear_aba864", 4), ("linear_kahan_li6", 6)]
)
def test_methods_converge_to_the_soliton_and_keep_its_norm(method, order):
    errors = []
    for n in (20, 40):
        sol = solve(SOLITON, method, (0, 2.0), dt=2.0 / n, t_eval=[0.0, 2.0])
        errors.append(abs(sol.y[:, -1] - SOLITON.exact(2.0)).max())
        norms = (sol.y**2).sum(0)
        assert abs(norms[1] / norms[0] - 1) < 2e-14  # less than 400 turns, each of rounding at random
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.5)


def test_the_norm_of_a_long_run_does_not_drift():
    """Transforms of the whole state would change it by 4e-17 a stage, always the same way: 2e-13 in this run."""
    sol = solve(SOLITON, "impulse", (0, 50.0), dt=0.01, t_eval=[0.0, 50.0])
    norms = (sol.y**2).sum(0)
    assert abs(norms[1] / norms[0] - 1) < 2e-14


@pytest.mark.parametrize("method", ["impulse", "linear_kahan_li6", "strang_parts", "implicit_explicit"])
def test_steps_of_a_complex_field_are_symplectic_and_go_back(method):
    y = RNG.normal(scale=0.7, size=(3, 48))
    sol = solve(TRAP, method, (0, 1), y, dt=0.1)
    np.testing.assert_array_equal(sol.y[1], solve(TRAP, method, (0, 1), y[1], dt=0.1).y)
    few = HamiltonianSystem.schroedinger("-rho**2", shape=3, length=2.0)
    assert symplecticity_defect(solve(few, method, (0, 0.1), y[0, :6], dt=0.1)) < 1e-14
    integrator = get(method)()
    np.testing.assert_allclose(integrator.inverse(TRAP, 0.0, integrator.step(TRAP, 0.0, y, 0.3), 0.3), y, atol=1e-13)
    tensor = solve(TRAP, method, (0, 1), torch.tensor(y), dt=0.1)
    np.testing.assert_allclose(tensor.y, sol.y, atol=1e-13)


def test_a_free_field_is_exact_in_one_step():
    free = HamiltonianSystem.schroedinger(None, shape=9, length=5.0)
    y0 = np.random.default_rng(2).normal(size=18)
    psi, k = y0[:9] + 1j * y0[9:], 2 * np.pi * np.fft.fftfreq(9, 5 / 9)
    end = np.fft.ifft(np.exp(-3.7j * k**2 / 2) * np.fft.fft(psi))
    found = solve(free, "impulse", (0, 3.7), y0, dt=3.7, t_eval=[3.7]).y[:, -1]
    np.testing.assert_allclose(found, np.r_[end.real, end.imag], atol=1e-13)
