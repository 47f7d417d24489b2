"""Bodies that interact in pairs: forces, conservation laws, cells, and bad input."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, solve, splitting_method
from sympflow.kernels.pairs import PairCode, PairForces
from sympflow.kernels.threads import at_most
from sympflow.schemes import SCHEMES
from sympflow.training.table_step import ArrayForces

GRAVITY, LENNARD_JONES = "-G*m1*m2/r", "4*(1/r**12 - 1/r**6)"


def gravity(n, seed=0, **more):
    rng = np.random.default_rng(seed)
    y0 = np.concatenate([rng.standard_normal(3 * n), 0.3 * rng.standard_normal(3 * n)])
    scene = {"params": {"G": 1 / n}, "softening": 0.2, "y0": y0, "dt": 0.02, "t_span": (0, 1)}
    return HamiltonianSystem.pairs(GRAVITY, masses=rng.uniform(1, 2, n), **scene | more)


def fluid(n_side=6, cutoff=2.0, box=True, **more):
    """Atoms near the places of a cubic lattice."""
    rng = np.random.default_rng(1)
    places = np.stack(np.meshgrid(*[np.arange(n_side)] * 3), -1).reshape(-1, 3) * 1.2
    q = places + rng.uniform(-0.1, 0.1, places.shape)
    y0 = np.concatenate([q.ravel(), rng.standard_normal(q.size) * 0.5])
    length = 1.2 * n_side if box else None
    masses = np.ones(len(q))
    return HamiltonianSystem.pairs(LENNARD_JONES, masses=masses, cutoff=cutoff, box=length, y0=y0, dt=0.002, **more)


def angular_momentum(sol, n):
    q, p = sol.y.reshape(2, n, 3, -1)
    return np.cross(q, p, axis=1).sum(0)


class TestFunctions:
    def test_of_three_bodies_are_those_of_symbols(self):
        three = gravity(3, softening=None)
        m, places = three.local.masses.tolist(), [[f"q{3 * i + k + 1}" for k in range(3)] for i in range(3)]
        V = []
        for i, j in ((0, 1), (0, 2), (1, 2)):
            r = " + ".join(f"({a} - {b})**2" for a, b in zip(places[i], places[j], strict=True))
            V.append(f"-{m[i] * m[j] / 3!r}/sqrt({r})")
        T = " + ".join(f"p{i + 1}**2/{2 * m[i // 3]!r}" for i in range(9))
        written = HamiltonianSystem.from_sympy(f"{T} + {' + '.join(V)}")
        Y = np.random.default_rng(3).standard_normal((4, 18))
        q, v = Y[:, :9], Y[::-1, :9]
        np.testing.assert_allclose(three.hamiltonian(Y), written.hamiltonian(Y), rtol=1e-12)
        np.testing.assert_allclose(three.force(q), written.force(q), rtol=1e-10)
        np.testing.assert_allclose(three.hessian_vector(q, v), written.hessian_vector(q, v), rtol=1e-9)
        np.testing.assert_allclose(three.energy_density(Y).sum(-1), three.hamiltonian(Y), rtol=1e-12)

    @pytest.mark.parametrize("system", [gravity(5), fluid(3, 1.5)], ids=["gravity", "Lennard-Jones"])
    def test_compiled_for_fits_are_those_of_arrays(self, system):
        rng = np.random.default_rng(4)
        q = system.y0[: system.ndof, None] + 0.01 * rng.standard_normal((system.ndof, 3))
        v = rng.standard_normal((2, *q.shape))
        compiled, arrays = PairForces(system.local, 1), ArrayForces(system, 1)
        for name, given in (("values", (q,)), ("along", (q, v))):
            found, known = (getattr(forces, name)(*given) for forces in (compiled, arrays))
            for one, other in zip(found, known, strict=True):
                scale = np.abs(other).max()  # of differences, in the slope of the gradient
                np.testing.assert_allclose(np.asarray(one) / scale, np.asarray(other) / scale, atol=1e-4)
        F, G = compiled.values(q)
        np.testing.assert_allclose(F.T, system.force(q.T), rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(G.T, -system.hessian_vector(q.T, system.velocity(F.T)), rtol=1e-9, atol=1e-6)

    def test_a_cut_off_is_smooth(self):
        two = HamiltonianSystem.pairs(LENNARD_JONES, masses=[1.0, 1.0], dim=1, cutoff=2.5)
        q = np.array([[0, 2.5 - 1e-6], [0, 2.5 + 1e-6], [0, 3.0]])
        assert np.abs(two.potential(q)).max() < 1e-12
        assert np.abs(two.force(q)).max() < 1e-6

    @pytest.mark.parametrize("system", [gravity(5), fluid(3, 1.5)], ids=["gravity", "Lennard-Jones"])
    def test_of_tensors_are_derivatives_of_each_other(self, system):
        q = torch.tensor(system.y0[: system.ndof], requires_grad=True)
        v = torch.randn(system.ndof, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        (slope,) = torch.autograd.grad(system.potential(q), q, create_graph=True)
        (product,) = torch.autograd.grad(slope @ v, q, create_graph=True)
        (bent,) = torch.autograd.grad(product @ v, q)
        for mine, theirs in (
            (-system.force(q), slope),
            (system.hessian_vector(q, v), product),
            (system.third_derivative(q, v, v), bent),
        ):
            torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9 * float(theirs.detach().abs().max()))


class TestRuns:
    @pytest.mark.parametrize(("method", "options"), [("verlet", {}), ("chin4a", {}), ("verlet", {"compensated": True})])
    @pytest.mark.parametrize("n", [4, 40], ids=["written out", "in memory"])
    def test_compiled_and_by_arrays_agree_and_conserve_momenta(self, n, method, options):
        system = gravity(n)
        sol = solve(system, method, **options)
        assert sol.stats["backend"] == "compiled"
        np.testing.assert_allclose(sol.y, solve(system, method, backend="array").y, rtol=0, atol=1e-12)
        p = sol.y[3 * n :].reshape(n, 3, -1).sum(0)
        L = angular_momentum(sol, n)
        steps, eps = len(sol.t), np.finfo(float).eps
        size = np.abs(sol.y).max() ** 2 * n
        assert np.abs(p - p[:, :1]).max() < 8 * steps * eps * size
        assert np.abs(L - L[:, :1]).max() < 32 * steps * eps * size

    @pytest.mark.parametrize(
        ("V", "more"),
        [
            *(("r**2/2", more) for more in ({}, {"box": 9.0}, {"cutoff": 3.0})),
            *(("Max(1 - r, 0)**2.5", {}), ("Min(r - 1, 0)**2", {"box": 9.0})),
        ],
    )
    def test_force_gradients_of_a_constant_slope_and_of_contacts(self, V, more):
        y0 = np.array([0, 0, 0.8, 0, 1.6, 0, 0.5, 0, 0, 0, 0, 0])
        system = HamiltonianSystem.pairs(V, masses=np.ones(3), dim=2, y0=y0, dt=0.02, **more)
        exact = solve(system, "dop853", t_eval=[1.0], rtol=1e-10, atol=1e-12).y
        for backend in ("compiled", "array"):
            sol = solve(system, "chin4a", t_eval=[1.0], backend=backend)
            np.testing.assert_allclose(sol.y, exact, atol=1e-6)

    def test_threads_share_a_large_system_and_keep_its_bits(self):
        system = gravity(330)
        runs = []
        for threads in (1, 3):
            with at_most(threads):
                runs.append(solve(system, "verlet", (0, 1), t_eval=[0.5, 1], backend="compiled").y)
        np.testing.assert_array_equal(*runs)
        together = gravity(330, softening=None)
        y0 = together.y0.copy()
        y0[:3] = y0[9:12]
        sol = solve(together, "verlet", (0, 1), y0)
        assert sol.status == -1
        assert len(sol.t) == 1

    @pytest.mark.parametrize("n", [4, 40], ids=["written out", "in memory"])
    def test_curvature_terms_are_those_of_arrays(self, n):
        chin = SCHEMES["chin4c"]
        curved = replace(chin, name="curved", curvatures=tuple(0.01 if g else 0.0 for g in chin.gradients))
        method = splitting_method(curved)
        compiled, by_arrays = (solve(gravity(n), method, (0, 0.2), backend=b).y for b in ("compiled", "array"))
        np.testing.assert_allclose(compiled, by_arrays, rtol=0, atol=1e-13)

    def test_open_space_with_a_cut_off(self):
        """A drop far away makes cells of most of the plane empty."""
        rng = np.random.default_rng(2)
        q = np.concatenate([rng.uniform(0, 5, (60, 2)), rng.uniform(300, 303, (20, 2))])
        y0 = np.concatenate([q.ravel(), np.zeros(160)])
        bodies = {"c": rng.uniform(1, 2, 80)}
        system = HamiltonianSystem.pairs(
            "c1*c2*exp(-r)", masses=np.ones(80), bodies=bodies, dim=2, cutoff=1.5, y0=y0, dt=0.05
        )
        sol = solve(system, "verlet", (0, 0.5))
        assert sol.stats["backend"] == "compiled"
        np.testing.assert_allclose(sol.y, solve(system, "verlet", (0, 0.5), backend="array").y, rtol=0, atol=1e-11)

    def test_a_thread_that_fails_ends_the_others(self, monkeypatch):
        system = gravity(330)
        function = PairCode.function

        def failing(self, name, width):
            run, fails = function(self, name, width), iter([False, True])

            def member(*given):
                if next(fails, False):
                    raise MemoryError("no room")
                run(*given)

            return member

        monkeypatch.setattr(PairCode, "function", failing)
        with at_most(3), pytest.raises(MemoryError, match="no room"):
            solve(system, "verlet", (0, 1), t_eval=[1], backend="compiled")

    def test_values_of_parameters_of_each_trajectory(self):
        system = gravity(4)
        together = solve(system, "verlet", params={"G": [0.25, 0.5]})
        alone = solve(system.with_params(G=0.5), "verlet")
        np.testing.assert_array_equal(together.y[1], alone.y)
        np.testing.assert_array_equal(together.y[0], solve(system, "verlet").y)
        with pytest.raises(ValueError, match=r"^`params` has 'g', and those of the system are G"):
            system.with_params(g=1.0)


@pytest.mark.parametrize(
    ("V", "more", "y0", "dt", "where"),
    [
        ("1/r", {"dim": 1}, [0, 1, 5, -5], 0.3, "r = 0"),
        ("r**-2", {"dim": 1}, [0, 1, 20, -20], 0.1, "r = 0"),
        ("log(r - a)", {"dim": 2, "params": {"a": 1.0}}, [0, 0, 3, 0, 9, 0, -9, 0], 0.1, "a - r = 0"),
        ("atanh(r/10)", {"dim": 2}, [0, 0, 8, 0, -10, 0, 10, 0], 0.05, "r - 10 = 0"),
        ("-log(1 - (r/2)**2)", {"dim": 3}, [0, 0, 0, 1.5, 0, 0, -10, 0, 0, 10, 0, 0], 0.05, "r - 2 = 0"),
        ("-log(1 - (r/2)**2)", {"dim": 1, "softening": 0.1}, [0, 1.5, -10, 10], 0.05, "r - 2 = 0"),
        ("-log(1 - (r/2)**2)", {"dim": 1, "box": 6.0}, [5, 0.5, -10, 10], 0.05, "r - 2 = 0"),
        ("1/(1 - cos(r))", {"dim": 2}, [0, 0, 9, 0, 10, 0, -10, 0], 0.05, "sin(r/2) = 0"),
        ("-tan(r)", {"dim": 2, "cutoff": 2.0}, [0, 0, 1.9, 0, 9, 0, -9, 0], 0.1, "cos(r) = 0"),
    ],
)
def test_a_run_that_passes_a_place_without_v_ends_there(V, more, y0, dt, where):
    system = HamiltonianSystem.pairs(V, masses=[1.0, 1.0], **more)
    still = np.array(y0, dtype=float) * np.repeat([1, 1e-3], len(y0) // 2)
    sol = solve(system, "verlet", (0, 3 * dt), np.stack([still, y0]), dt=dt)
    np.testing.assert_array_equal(sol.status, [0, -1])
    assert f"passed {where} of two bodies, where H is infinite" in sol.message


class TestBadInput:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"masses": [1.0, -1.0]}, r"^`masses` must be positive; that of body 1 is -1"),
            ({"masses": [1.0, np.nan]}, "^`masses` must be finite; that of body 1"),
            ({"masses": [1.0]}, "^`masses` must be those of two bodies or more"),
            ({"masses": [[1.0, 1.0]]}, r"^`masses` must have shape \(n,\)"),
            ({"masses": "heavy"}, r"^`masses` must be real numbers"),
            ({"masses": np.broadcast_to(1.0, 10**13)}, "^`masses` has 1e\\+13 degrees of freedom"),
            ({"dim": 4}, "^`dim` must be 1, 2 or 3"),
            ({"box": 4.0, "cutoff": 2.1}, "^`cutoff` 2.1 is longer than half the box, 2:"),
            ({"box": [1.0, 2.0]}, "^`box` must be a length, or 3 of them"),
            ({"box": -1.0}, "^`box` must have positive"),
            ({"cutoff": 0.0}, "^`cutoff` must be a positive, finite length"),
            ({"softening": -1.0}, "^`softening` must be a positive, finite length"),
            ({"params": {"G": 1.0, "k": 2.0}}, "^`params` has 'k', which the potential does not use"),
            ({"params": {}}, "^`potential` cannot be parsed|^`potential` holds G"),
            ({"params": {"G": [1.0, 2.0]}}, "^`params` has G = .* goes to `bodies`"),
            ({"bodies": {"c": [1.0, 2.0]}}, "^`bodies` has 'c', and V uses neither c1 nor c2"),
            ({"bodies": {"c": [1.0, 2.0, 3.0]}}, "^`bodies` has c of 3 values, and there are 2 `masses`"),
            ({"potential": "G*m1/r"}, "^`potential` must be the same with the two bodies exchanged"),
            ({"potential": "G*m1*m2"}, "^`potential` must depend on r"),
            ({"potential": 3.0, "params": {}}, "^`potential` must depend on r"),
            ({"y0": np.zeros(5)}, r"^`y0` must have shape \(12,\)"),
        ],
    )
    def test_is_refused_at_once(self, change, message):
        given = {"potential": GRAVITY, "masses": [1.0, 2.0], "params": {"G": 1.0}} | change
        with pytest.raises((ValueError, TypeError), match=message):
            HamiltonianSystem.pairs(**given)

    @pytest.mark.parametrize("softening", [None, 0.1])
    def test_bodies_that_a_step_leaps_over_are_named(self, softening):
        system = HamiltonianSystem.pairs("-1/r", masses=np.ones(2), dim=2, softening=softening)
        y0 = np.zeros((2, 8))
        y0[:, 2] = 9.0, 1.0  # the second pair meets at t = π/4, all but head-on
        y0[:, 7] = 1e-6
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            for start in (y0, y0[1]):
                assert solve(system, "verlet", (0, 1), start, dt=0.01, backend="array").success
        if softening:
            assert not found
            return
        assert [str(w.message).partition("It was lost")[0].split(" went")[0] for w in found] == [
            "The energy of trajectory 1, the first of 1,",
            "The energy",
        ]
        for w in found:
            assert w.category is RuntimeWarning
            assert "between t = 0.77 and 0.78, where the bodies 0 and 1 have gained most" in str(w.message)

    def test_bodies_at_one_place_are_named(self):
        system = gravity(4, softening=None, y0=None)
        y0 = gravity(4).y0.copy()
        y0[3:6] = y0[9:12]
        sol = solve(system, "verlet", (0.5, 1), y0)
        assert sol.status == -1
        assert "At t = 0.5 the bodies 1 and 3 are at one place, r = 0: pass `softening`" in sol.message
