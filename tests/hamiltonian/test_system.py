"""HamiltonianSystem: symbolic and callable definitions agree with each other and with automatic differentiation."""

import copy
import json
import math
import pickle
from fractions import Fraction

import numpy as np
import pytest
import sympy
import torch
from conftest import refusals
from numba import njit

from sympflow import Ball, HamiltonianSystem, solve, systems, volume_error
from sympflow.hamiltonian.symbolic import MOST_WRITTEN, generate, hessian

made = HamiltonianSystem.from_sympy

SYSTEMS = {
    "harmonic": systems.harmonic_oscillator(3.0),
    "henon_heiles": systems.henon_heiles(),
    "pendulum": systems.pendulum(),
    "masses": made("p1**2/4 + p1*p2/5 + p2**2/6 + sin(q1)*exp(q2) + sqrt(2)*q2**2"),
    "relativistic": made("sqrt(1 + p**2) + q**4"),
    "not separable": made("(p**2 + q**2)**2/4 + q*p"),
    "constant force": made("p**2/2 + 3*q"),
    "callable": HamiltonianSystem(lambda q: (q**4).sum(-1) / 4 + torch.cos(q[..., 0]), ndof=2, mass=[1.0, 2.0]),
    "general": HamiltonianSystem(hamiltonian=lambda q, p: (p**2).sum(-1) / 2 * (1 + q[..., 0] ** 2), ndof=1),
}


def states(system, *batch):
    return np.random.default_rng(0).uniform(-0.6, 0.6, (*batch, 2 * system.ndof))


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_derivatives_are_those_of_H(name, batch):
    system = SYSTEMS[name]
    y = torch.tensor(states(system, *batch))

    def H(x):
        return system.hamiltonian(x).sum()

    gradient = torch.func.grad(H)(y)
    d = system.ndof
    J_gradient = torch.cat([gradient[..., d:], -gradient[..., :d]], -1)
    torch.testing.assert_close(system.gradient(y), gradient, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(system.vector_field(y), J_gradient, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(system(0.0, y), J_gradient, rtol=1e-13, atol=1e-13)
    flat = y.reshape(-1, 2 * d)
    hessian = torch.stack([torch.func.hessian(system.hamiltonian)(x) for x in flat]).reshape(*batch, 2 * d, 2 * d)
    torch.testing.assert_close(system.hessian(y), hessian, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("method", ["hamiltonian", "gradient", "vector_field", "hessian"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numpy_and_torch_agree_and_keep_the_dtype(name, method, dtype):
    system = SYSTEMS[name]
    y = torch.tensor(states(system, 4), dtype=dtype)
    by_torch, by_numpy = getattr(system, method)(y), getattr(system, method)(y.numpy())
    assert by_torch.dtype == dtype
    assert by_numpy.dtype == y.numpy().dtype
    eps = torch.finfo(dtype).eps
    np.testing.assert_allclose(by_numpy, by_torch.numpy(), rtol=64 * eps, atol=64 * eps)


def test_structure_is_recognised():
    assert SYSTEMS["henon_heiles"].separable
    assert SYSTEMS["henon_heiles"].inverse_mass is None  # unit masses are left out
    assert SYSTEMS["masses"].inverse_mass.shape == (2, 2)
    assert SYSTEMS["relativistic"].separable
    assert not SYSTEMS["relativistic"].quadratic_kinetic
    assert not SYSTEMS["not separable"].separable
    assert SYSTEMS["callable"].inverse_mass.tolist() == [1.0, 0.5]
    expanded = made("(p + q)**2/2 - p*q")
    assert expanded.separable
    assert expanded.inverse_mass is None


def numba_pendulum(with_hessian=True):
    @njit
    def potential(q):
        return 1 - np.cos(q[0]) + q[0] * q[1] ** 2

    @njit
    def gradient(q, out):
        out[0], out[1] = np.sin(q[0]) + q[1] ** 2, 2 * q[0] * q[1]

    @njit
    def hessian_vector(q, v, out):
        out[0] = np.cos(q[0]) * v[0] + 2 * q[1] * v[1]
        out[1] = 2 * q[1] * v[0] + 2 * q[0] * v[1]

    return HamiltonianSystem(
        potential, gradient=gradient, hessian_vector=hessian_vector if with_hessian else None, ndof=2, mass=[1.0, 2.0]
    )


class TestNumbaFunctions:
    """They serve tensors too, with the derivatives that they are themselves."""

    system = numba_pendulum()
    symbolic = made("p1**2/2 + p2**2/4 + 1 - cos(q1) + q1*q2**2")

    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_agree_with_the_symbolic_system_on_arrays_and_tensors(self, batch, dtype):
        y = torch.tensor(states(self.system, *batch), dtype=dtype)
        eps = 64 * torch.finfo(dtype).eps
        for method in ("hamiltonian", "gradient", "vector_field", "hessian"):
            expected = getattr(self.symbolic, method)(y)
            on_tensor, on_array = (getattr(self.system, method)(x) for x in (y, y.numpy()))
            assert on_tensor.dtype == dtype
            assert on_array.dtype == y.numpy().dtype
            torch.testing.assert_close(on_tensor, expected, rtol=eps, atol=eps)
            np.testing.assert_allclose(on_array, expected.numpy(), rtol=eps, atol=eps)

    def test_third_derivatives_are_refused(self):
        q = torch.tensor([0.3, 0.2], dtype=torch.float64, requires_grad=True)
        with pytest.raises(ValueError, match=r"^`hessian_vector` would have to be differentiated.*from_sympy\.$"):
            self.system.hessian_vector(q, torch.ones(2, dtype=torch.float64)).sum().backward()
        sol = solve(self.system, "omelyan4", (0, 0.2), y0=[0.3, 0.2, 0.1, -0.2])
        with pytest.raises(ValueError, match=r"^`hessian_vector` would have to be differentiated"):
            volume_error(sol)

    def test_in_vmap(self):
        y = torch.tensor(states(self.system, 4))
        gradient = torch.func.vmap(torch.func.grad(self.system.hamiltonian))(y)
        torch.testing.assert_close(gradient, self.system.gradient(y))
        jacobian = torch.func.vmap(torch.func.jacfwd(self.system.force))(y[:, :2])
        torch.testing.assert_close(jacobian, -self.system.potential_hessian(y[:, :2]))

    def test_gradients_flow_through_solve(self):
        def end(y0):
            return solve(self.system, "verlet", (0, 0.2), y0=y0, dt=0.1).y[:, -1]

        y0 = torch.tensor([0.3, 0.2, 0.1, -0.2], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(end, y0)

    def test_derivatives_flow_in_both_modes(self):
        q = torch.tensor(states(self.system, 3)[:, :2], requires_grad=True)
        v = torch.randn(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
        assert torch.autograd.gradcheck(self.system.potential, q, check_forward_ad=True)
        assert torch.autograd.gradcheck(self.system.force, q, check_forward_ad=True)
        assert torch.autograd.gradgradcheck(self.system.potential, q)
        fixed = q.detach()
        assert torch.autograd.gradcheck(lambda w: self.system.hessian_vector(fixed, w), v, check_forward_ad=True)

    @pytest.mark.parametrize("method", ["verlet", "dopri5", "rk45", "omelyan4"])
    def test_every_kind_of_method_runs(self, method):
        y0 = np.array([[0.3, 0.2, 0.1, -0.2], [0.1, -0.3, 0.4, 0.1]])
        sol = solve(self.system, method, (0, 0.5), y0)
        splitting = method in ("verlet", "omelyan4")  # without and with force gradients, whose loops differ
        assert sol.stats["backend"] == {"rk45": "scipy", "dopri5": "torchdiffeq"}.get(method, "compiled")
        for system in (self.system, self.symbolic):
            expected = solve(system, method, (0, 0.5), y0, backend="array" if splitting else "auto")
            np.testing.assert_allclose(sol.y[..., -1], expected.y[..., -1], atol=1e-12)

    def test_can_be_copied(self):
        self.system.force(torch.zeros(2))
        same = pickle.loads(pickle.dumps(self.system))
        torch.testing.assert_close(same.force(torch.ones(2)), self.system.force(torch.ones(2)))


test_bad_definitions_are_named = refusals(
    (lambda: made("p**2/2 + k*q**2"), "^`expression` holds k without a value"),
    (lambda: made("p**2/2 + t*q"), TypeError, "^`expression` depends on the time"),
    (lambda: made("p**2/2 + ("), "^`expression` cannot be parsed"),
    (lambda: made("p1**2 + q + q2"), "^`expression` mixes q, p"),
    (lambda: made("p1**2 + q1 + q"), "^`expression` mixes q, p"),
    (lambda: made("p**2 + q99999999999"), "^`expression` has coordinates numbered up"),
    (lambda: made("p1**2 + q" + "9" * 5000), "holds q9{39}… without"),
    (lambda: made("3"), "^`expression` must depend on q1"),
    (lambda: made("p**2 + q", params={"k": 1}), "^`params` has 'k'"),
    (lambda: made("p**2 + q", params={"q": 1}), "^`params` gives a value to 'q'"),
    (lambda: made("p**2 + k*q", params={"k": np.inf}), "k = inf"),
    (lambda: made("p**2 + k*q", params={"k": "a"}), "^`params` has k = 'a'"),
    (lambda: made(sympy.I * sympy.Symbol("q")), "^`expression` is complex"),
    (lambda: made("p**2 + q", y0=[1, 2, 3]), r"^`y0` must have shape \(2,\)"),
    (lambda: made("p**2 + q", dt=0), "^`dt` must be positive"),
    (lambda: made("p**2 + q", domain=Ball([0.0] * 4, 1)), "^`domain` must be"),
    (lambda: made("p**2 + q", energy_scale=0), "^`energy_scale` must be"),
    (lambda: HamiltonianSystem(lambda q: q, ndof=0), "^`ndof` must be a positive integer"),
    (lambda: HamiltonianSystem(ndof=1), TypeError, "^`potential` or `hamiltonian` must be given"),
    (lambda: HamiltonianSystem(3, ndof=1), TypeError, "^`potential` must be callable"),
    (lambda: HamiltonianSystem(lambda q: q, ndof=2, mass=[1.0]), "^`mass` must be a number"),
    (lambda: HamiltonianSystem(lambda q: q, ndof=2, mass=[1.0, -1.0]), "^`mass` must be finite"),
    (
        lambda: HamiltonianSystem(lambda q: q, ndof=2, mass=[[1, 2], [0, 1]]),
        r"^`mass` must be finite, symmetric; its entry \[0, 1\] is 2, \[1, 0\] is 0",
    ),
    (lambda: HamiltonianSystem(lambda q: q, ndof=2, mass=1j), TypeError, "^`mass` must be real numbers"),
    (
        lambda: HamiltonianSystem(lambda q: q, ndof=2, stiffness_matrix=1j * np.eye(2)),
        TypeError,
        "^`stiffness_matrix` must be real numbers",
    ),
    (
        lambda: HamiltonianSystem(lambda q: q, ndof=2, stiffness_matrix=[[1, math.nan], [0, 1]]),
        r"^`stiffness_matrix` must be finite, symmetric; its entry \[0, 1\] is nan\.",
    ),
    (lambda: HamiltonianSystem(lambda q: q, ndof="a"), "^`ndof` must be a positive integer"),
    (lambda: HamiltonianSystem(lambda q: q, ndof=math.inf), "^`ndof` must be a positive integer"),
    (lambda: HamiltonianSystem(hamiltonian=lambda q, p: q, ndof=1, mass=2), TypeError, "^`mass` only goes with"),
    (lambda: systems.harmonic_oscillator(-1), "^`omega` must be positive"),
    (lambda: systems.harmonic_oscillator(1e308), "^`omega` must be positive"),
)


@pytest.mark.parametrize("q", [0.3, -0.4])
def test_kinks_and_constants_after_differentiation(q):
    """The δ of a kink is left out of second derivatives, everywhere alike; constants such as √π become numbers."""
    terms = {
        "max(q1, 0)**2 + abs(q1)": 2 * max(q, 0) + np.sign(q),
        "sign(q2)*q2": np.sign(q),
        "Heaviside(q3)*q3**2": 2 * q * (q > 0),
        "Min(q4**2, 1, q4**4)": 4 * q**3,
        "erf(q5)": 2 / np.sqrt(np.pi) * np.exp(-(q**2)),
    }
    kinetic = "(p1**2 + p2**2 + p3**2 + p4**2 + p5**2)/2"
    system = made(" + ".join([kinetic, *terms]))
    y = np.repeat([q, 0.2], 5)
    np.testing.assert_allclose(system.gradient(y)[:5], list(terms.values()), rtol=1e-12)
    np.testing.assert_allclose(system.gradient(torch.tensor(y))[:5], list(terms.values()), rtol=1e-12)
    assert np.isfinite(system.hessian(y)).all()
    # its stages are kicks with force gradients, and without
    compiled, array = (solve(system, "omelyan4", (0, 0.1), y0=y, backend=b) for b in ("compiled", "array"))
    np.testing.assert_allclose(compiled.y, array.y, atol=1e-14)


def doubling(q):
    q *= 2
    return q / 2


@pytest.mark.parametrize("method", ["verlet", "rk45", "rk4", "dopri5"])
def test_a_function_that_writes_into_the_state_is_refused(method):
    """NumPy's arrays are read-only; a tensor's version tells."""
    V = {"potential": lambda q: (q**2).sum(-1) / 2, "ndof": 1}
    with pytest.raises(
        ValueError, match=r"^`gradient` writes into its argument, the state of the run: let it work on a"
    ):
        solve(HamiltonianSystem(**V, gradient=doubling), method, (0, 1), [1.0, 0.0])
    own = np.array([1.0, 0.0])
    solve(HamiltonianSystem(**V, gradient=lambda q: q), method, (0, 1), own)
    assert own.flags.writeable
    writes = HamiltonianSystem(**V, gradient=lambda q: q, hessian_vector=lambda q, v: doubling(v))
    with pytest.raises(ValueError, match=r"^`hessian_vector` writes into its argument"):
        writes.hessian(own)
    assert own.tolist() == [1.0, 0.0]
    with pytest.raises(ValueError, match=r"^`potential` writes into its argument.*q\.clone\(\)"):
        HamiltonianSystem(potential=lambda q: (doubling(q) ** 2).sum(-1), ndof=1).potential(own[:1])


@pytest.mark.parametrize("name", ["hamiltonian", "gradient", "hessian", "vector_field"])
@pytest.mark.parametrize("width", [3, 5])
def test_states_of_another_width_are_refused(name, width):
    with pytest.raises(ValueError, match=r"^`y` must have shape \(\.\.\., 4\).* got \(2, " + str(width)):
        getattr(systems.henon_heiles(), name)(np.zeros((2, width)))


class TestParameters:
    """They are part of H, so that a change of theirs would be one of its name alone."""

    system = made("p**2/2 + a*q**4", params={"a": 1.0})

    @pytest.mark.parametrize(
        "change",
        [
            lambda p: p.__setitem__("a", 5.0),
            lambda p: p.__delitem__("a"),
            lambda p: p.update(a=5.0),
            lambda p: p.__ior__({"a": 5.0}),
            lambda p: p.setdefault("b", 1.0),
            lambda p: p.pop("a"),
            lambda p: p.popitem(),
            lambda p: p.clear(),
        ],
    )
    def test_are_to_be_read_only(self, change):
        with pytest.raises(TypeError, match=r"^`params` of a system .* make a system with other parameters, by its"):
            change(self.system.params)
        assert self.system.params == {"a": 1.0}

    @pytest.mark.parametrize("value", [1 + 2j, np.complex128(2), 10**400, math.nan, math.inf, True, "2", [1.0], None])
    def test_that_are_no_finite_real_numbers_are_refused(self, value):
        with pytest.raises(ValueError, match=r"^`params` has a = .*: give a finite real number\.$"):
            made("p**2/2 + a*q**2", params={"a": value})

    @pytest.mark.parametrize(
        ("name", "hint"),
        [("E", "Euler's number is written exp(1)"), ("I", "imaginary unit"), *((n, "") for n in ("N", "O", "Q", "S"))],
    )
    def test_may_be_named_as_sympy_names_its_own_things(self, name, hint):
        text = f"p**2/2 + {name}*q**2/2"
        with pytest.raises(ValueError, match=rf"^`expression` holds {name} without a value: give it in `params`") as e:
            made(text)
        assert hint in str(e.value)
        assert made(text, params={name: 4.0}).force(np.array([1.0])) == -4.0

    def test_pi_is_a_constant_unless_it_is_given(self):
        assert made("p**2/2 + pi*q").force(np.array([1.0])) == -np.pi
        assert made("p**2/2 + pi*q", params={"pi": 2}).force(np.array([1.0])) == -2.0

    @pytest.mark.parametrize(
        ("scene", "error"),
        [
            ({"y0": [10**400, 0]}, TypeError),
            ({"y0": [1j, 0]}, TypeError),
            ({"t_span": (0, 10**400)}, ValueError),
            ({"t_span": (0, math.nan)}, ValueError),
            ({"dt": np.complex128(1)}, ValueError),
            ({"dt": True}, ValueError),
            ({"energy_scale": 10**400}, ValueError),
            ({"energy_scale": np.complex128(1)}, ValueError),
            ({"params": [("a", 1.0)]}, TypeError),
        ],
    )
    def test_of_the_scene_are_checked_too(self, scene, error):
        with pytest.raises(error, match=f"^`{next(iter(scene))}` must be"):
            made("p**2/2 + q**2/2", **scene)

    @pytest.mark.parametrize("value", [2, np.float32(2), np.array(2.0), Fraction(2), sympy.Integer(2)])
    def test_of_every_kind_of_number_are_numbers_of_python(self, value):
        system = made("p**2/2 + a*q**2/2", params={"a": value})
        assert type(system.params["a"]) in (int, float)
        assert system.params["a"] == 2 == -system.force(np.array([1.0]))[0]

    def test_survive_pickles_copies_and_json(self):
        for again in (pickle.loads(pickle.dumps(self.system)), copy.deepcopy(self.system), copy.copy(self.system)):
            assert again.params == {"a": 1.0}
            with pytest.raises(TypeError, match=r"^`params`"):
                again.params["a"] = 5.0
        assert json.dumps(self.system.params) == '{"a": 1.0}'


@pytest.mark.parametrize("domain", [None, Ball([0.0, 0.0], 1.0)])
@pytest.mark.parametrize("method", ["kahan_li8", "log_kahan_li8", "tao4"])
def test_without_y0_every_method_takes_the_same_default_step_whatever_was_read_before(domain, method):
    """Its source is the fastest motion, here of rate √3|q|: at the given states, or in the domain if there is one."""
    y0 = np.array([[9.0, 0.0], [0.1, 0.1]])
    fresh, read = (made("p**2/2 + q**4/4", domain=domain) for _ in range(2))
    dt = float(f"{0.05 / (np.sqrt(3) * 9):.2g}") if domain is None else read.dt
    assert [solve(system, method, (0, 1), y0).stats["n_steps"] for system in (fresh, read)] == [np.ceil(1 / dt)] * 2


def test_long_sums_are_evaluated_in_pieces(monkeypatch):
    monkeypatch.setattr("sympflow.hamiltonian.symbolic.LONGEST_SUM", 3)
    system = made("p**2/2 + " + " + ".join(f"q**2/(q + {k})" for k in range(1, 9)))
    q, k = np.array([0.3]), np.arange(1, 9)
    assert math.isclose(system.potential(q), (q**2 / (q + k)).sum(), rel_tol=1e-14)
    assert math.isclose(system.potential(torch.from_numpy(q)).item(), (q**2 / (q + k)).sum(), rel_tol=1e-14)


@pytest.mark.parametrize(
    ("potential", "error", "message"),
    [
        (lambda q: q, ValueError, r"^`potential` must return shape \(5,\) .*; got \(5, 2\)"),
        (lambda q: (q**2).sum(), ValueError, r"^`potential` must return shape \(5,\)"),
        (lambda q: np.cos(q.detach().numpy()), TypeError, "^`potential` failed on a torch tensor"),
    ],
)
def test_functions_of_the_wrong_kind_are_explained(potential, error, message):
    system = HamiltonianSystem(potential, ndof=2)
    with pytest.raises(error, match=message):
        system.vector_field(np.zeros((5, 4)))
        system.hamiltonian(np.zeros((5, 4)))


def test_hessians_of_many_variables_are_those_of_their_expressions():
    """They are programs: the expression is differentiated as a reference."""
    d = 20
    bonds = " + ".join(f"k*cos(q{i} - q{i + 1})/(1 + q{i}**2) + sqrt(2 + q{i}*q{i + 1})" for i in range(1, d))
    system = made(" + ".join(f"p{i}**2/2" for i in range(1, d + 1)) + " + " + bonds, params={"k": 0.3})
    symbols, q = system.symbols, np.random.default_rng(0).uniform(-1, 1, size=(3, d))
    assert d > MOST_WRITTEN
    reference = generate(list(hessian(symbols.V, symbols.q)), symbols.q, "numpy")
    expected = np.stack([np.broadcast_to(x, 3) for x in reference(*q.T)], axis=-1).reshape(3, d, d)
    np.testing.assert_allclose(system.potential_hessian(q), expected, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(system.potential_hessian(torch.tensor(q)).numpy(), expected, rtol=1e-13, atol=1e-14)
