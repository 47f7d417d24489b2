"""Lattices of any size: the same H as written out by every site and bond, and its derivatives."""

from __future__ import annotations

import itertools
import pickle
import re

import numpy as np
import pytest
import torch

import sympflow as sf
from sympflow import HamiltonianSystem

RNG = np.random.default_rng(20)
BOUNDARIES = ("periodic", "fixed", "free")


def written_out(onsite, bonds, shape, boundary, kinetic=None, fields=("q",), params=None):
    """The same system by `from_sympy`: its terms one by one, in the order that the docstring of `lattice` states."""
    n, single = int(np.prod(shape)), len(fields) == 1
    index = np.arange(n).reshape(shape)
    boundary = (boundary,) * len(shape) if isinstance(boundary, str) else boundary

    def put(expression, names):
        return (
            "(" + re.sub(r"[A-Za-z_]\w*", lambda word: f"({names.get(word.group(), word.group())})", expression) + ")"
        )

    def values(site):
        return {k: repr(float(np.broadcast_to(v, shape).flat[site])) for k, v in (params or {}).items()}

    def position(f, site):
        return "0" if site is None else f"q{f * n + site + 1}"

    terms = []
    for i in range(n):
        here = {name: position(f, i) for f, name in enumerate(fields)}
        momenta = {"p" if single else f"p_{name}": f"p{f * n + i + 1}" for f, name in enumerate(fields)}
        terms.append(put(kinetic or " + ".join(f"{p}**2/2" for p in momenta), {**momenta, **values(i)}))
        if onsite:
            terms.append(put(onsite, {**here, **values(i)}))
    for (k, V), axis in itertools.product(bonds.items(), range(len(shape))):
        for first in itertools.product(*(range(-k if a == axis else 0, m) for a, m in enumerate(shape))):
            ends = []
            for at in (first[axis], first[axis] + k):
                inside = 0 <= at < shape[axis]
                if boundary[axis] == "periodic":
                    inside = first[axis] >= 0
                place = [*first]
                place[axis] = at % shape[axis]
                ends.append(int(index[tuple(place)]) if inside else None)
            if ends == [None, None] or (boundary[axis] == "free" and None in ends):
                continue
            wall = [*first]
            wall[axis] = 0
            own = values(int(index[tuple(wall)]) if ends[0] is None else ends[0])
            r = {
                "r" if single else f"r_{name}": f"{position(f, ends[1])} - {position(f, ends[0])}"
                for f, name in enumerate(fields)
            }
            terms.append(put(V, {**r, **own}))
    return HamiltonianSystem.from_sympy(" + ".join(terms))


RING = {"onsite": None, "bond": "r**2/2 + r**4/4", "shape": (6,)}
DISORDERED = {
    "onsite": "a*q**2/2",
    "bond": {1: "exp(r) - r", 2: "b*r**3/3"},
    "kinetic": "p**2/(2*m)",
    "shape": (7,),
    "params": {"a": RNG.random(7), "b": 0.3, "m": RNG.random(7) + 0.5},
}
SHEET = {"onsite": "1 - cos(q)", "bond": "k*r**2/2 + r**3/3", "shape": (3, 4), "params": {"k": RNG.random((3, 4))}}
FIELDS = {
    "onsite": "u**2*v**2/2 + u**4/4",
    "bond": "r_u**2/2 + r_v**2/2 + r_u**2*r_v",
    "fields": ("u", "v"),
    "shape": (3, 2, 1),
}
MIXED_MASSES = {
    "onsite": "u*v",
    "bond": "r_u**2/2 + r_v**4/4",
    "fields": ("u", "v"),
    "kinetic": "p_u**2/2 + p_v**4/4 + p_u*p_v",
    "shape": (3,),
}
CASES = [
    (RING, "periodic"),
    *((DISORDERED, boundary) for boundary in BOUNDARIES),
    (SHEET, ("fixed", "free")),
    (FIELDS, ("periodic", "free", "fixed")),
    (MIXED_MASSES, "free"),
]


@pytest.mark.parametrize(("definition", "boundary"), CASES)
def test_a_lattice_is_the_sum_over_its_sites_and_bonds(definition, boundary):
    lattice = HamiltonianSystem.lattice(**definition, boundary=boundary)
    bonds = definition["bond"] if isinstance(definition["bond"], dict) else {1: definition["bond"]}
    plain = written_out(**{k: v for k, v in definition.items() if k != "bond"}, bonds=bonds, boundary=boundary)
    d = plain.ndof
    assert lattice.ndof == d
    assert lattice.quadratic_kinetic == plain.quadratic_kinetic
    y, (v, w) = RNG.uniform(-0.8, 0.8, (2, 2 * d)), RNG.normal(size=(2, d))
    q = y[:, :d]

    def same(found, expected):  # sums of some dozen terms each
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13 * max(1.0, abs(expected).max()))

    same(lattice.hamiltonian(y), plain.hamiltonian(y))
    same(lattice.gradient(y), plain.gradient(y))
    same(lattice.hessian(y), plain.hessian(y))
    same(lattice.hessian_vector(q, v), plain.hessian_vector(q, v))
    same(lattice.energy_density(y).reshape(2, -1).sum(-1), plain.hamiltonian(y))
    step = 1e-5
    change = lattice.hessian_vector(q + step * w, v) - lattice.hessian_vector(q - step * w, v)
    np.testing.assert_allclose(lattice.third_derivative(q, v, w), change / (2 * step), rtol=1e-6, atol=1e-7)
    if plain.quadratic_kinetic:
        same(lattice.curvature_gradient(q), plain.curvature_gradient(q))
    y_followed = torch.tensor(y, requires_grad=True)
    (slope,) = torch.autograd.grad(lattice.hamiltonian(y_followed).sum(), y_followed)
    same(slope.numpy(), lattice.gradient(y))
    again = pickle.loads(pickle.dumps(lattice))
    np.testing.assert_array_equal(again.gradient(y), lattice.gradient(y))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"shape": (0,)}, "`shape` must be one to 3 positive integers"),
        ({"shape": (4, 4, 4, 4)}, "`shape` must be one to 3"),
        ({"shape": 2.5}, "`shape`"),
        ({"shape": (2,)}, "`shape` has an axis of 2 sites"),
        ({"shape": (10**6, 10**6)}, "`shape` has 1e.12 degrees of freedom.*GB"),
        ({"boundary": "open"}, "`boundary` must be one of 'periodic', 'fixed', 'free'"),
        ({"boundary": ("free", "free")}, "`boundary`.*1 axes"),
        ({"bond": "q**2"}, "`bond` holds q"),
        ({"bond": "k*r**2"}, "`bond` holds k"),
        ({"bond": "1"}, "`bond` must depend on r"),
        ({"bond": "r +* 2"}, "`bond` cannot be parsed"),
        ({"bond": {0: "r**2"}}, "`bond` by distances"),
        ({"bond": None}, "`onsite` or `bond`"),
        ({"bond": {}}, "`onsite` or `bond`"),
        ({"onsite": "p"}, "`onsite` holds p"),
        ({"onsite": "q*cos(t)"}, "`onsite` holds t, and such systems do not depend on the time"),
        ({"kinetic": "p**2/2 + q"}, "`kinetic` holds q"),
        ({"fields": ("u", "u")}, "`fields`"),
        ({"fields": ("u", "r_u"), "bond": "r_u**2", "kinetic": "p_u**2 + p_r_u**2"}, "`fields`"),
        ({"params": {"k": 1.0}}, "`params` has 'k', which no expression uses"),
        ({"params": {"k": np.ones(5)}, "onsite": "k*q**2"}, r"`params` has k of shape \(5,\)"),
        ({"params": {"k": np.full(6, np.nan)}, "onsite": "k*q**2"}, "`params` has k with a value that is not finite"),
        ({"params": {"r": 1.0}}, "`params` gives a value to 'r'"),
        ({"params": {"m": 0.0}, "kinetic": "m*p**2"}, "`kinetic` has a mass"),
        ({"y0": np.zeros(11)}, r"`y0` must have shape \(12,\)"),
    ],
)
def test_bad_lattices_are_refused(changed, message):
    with pytest.raises((ValueError, TypeError), match=message):
        HamiltonianSystem.lattice(**{**RING, **changed})


def test_trajectories_have_numbers_of_their_own_and_share_arrays():
    system = HamiltonianSystem.lattice(**DISORDERED, y0=np.full(14, 0.1))
    options = {"t_span": (0, 1), "dt": 0.1, "t_eval": [0.5, 1]}
    together = sf.solve(system, "verlet", params={"b": [0.3, 0.7, 0.3]}, **options)
    alone = sf.solve(system.with_params(b=0.7), "verlet", **options)
    np.testing.assert_array_equal(together.y[1], alone.y)
    np.testing.assert_array_equal(together.y[0], together.y[2])
    np.testing.assert_array_equal(together.energy()[1], alone.energy())
    swept = sf.ensemble(system, "verlet", (0, 1), system.y0, dt=0.1, params={"b": [0.3, 0.7]}, t_eval=[0.5, 1])
    np.testing.assert_array_equal(np.squeeze(swept.y)[1], alone.y)
    with pytest.raises(TypeError, match="`params` has 'm', an array of the sites"):
        sf.solve(system, "verlet", params={"m": [1.0, 2.0]}, **options)


class TestPoles:
    """Bonds and sites at which V is infinite, over which a step leaps without a trace."""

    LENNARD_JONES = "(1 + r)**-12 - 2*(1 + r)**-6"

    @pytest.mark.parametrize(
        ("definition", "dt", "where"),
        [
            ({"bond": LENNARD_JONES, "boundary": "free"}, 0.05, "r + 1 = 0 at the bond of 2 and 3"),
            ({"bond": "-log(1 - r**2/c**2)/2", "params": {"c": 1.2}}, 0.2, "c - r = 0 at the bond of 3 and 4"),
            ({"onsite": "-1/(q - 1)**2/8"}, 0.15, "q - 1 = 0 at the site 4"),
            ({"bond": "csch(1 + r)**2", "boundary": "free"}, 0.5, "r + 1 = 0 at the bond of 4 and 5"),
            ({"bond": "coth(2 + 2*r)", "boundary": "free"}, 0.5, "r + 1 = 0 at the bond of 4 and 5"),
            ({"bond": "atanh(r/2)/9"}, 0.5, "r - 2 = 0 at the bond of 3 and 4"),
            ({"bond": "1/(1 - cos(r + 2))", "boundary": "free"}, 0.5, "sin(r/2 + 1) = 0 at the bond of 4 and 5"),
            ({"bond": "1e-3/((r - 1)**2 - 1/4)"}, 0.5, "r - 1.5 = 0 at the bond of 3 and 4"),
        ],
    )
    def test_a_run_that_passed_one_ends_there(self, definition, dt, where):
        system = HamiltonianSystem.lattice(**definition, shape=6)
        y0 = np.zeros((2, 12))
        y0[1, 10] = 5.0
        sol = sf.solve(system, "verlet", (0, 1), y0, dt=dt)
        np.testing.assert_array_equal(sol.status, [0, -1])
        assert f"passed {where}, where H is infinite" in sol.message

    def test_a_start_at_one_is_named(self):
        system = HamiltonianSystem.lattice(bond="1/(1 + r)", shape=(4, 4), boundary=("fixed", "periodic"))
        y0 = np.zeros(32)
        y0[5] = 1.0
        sol = sf.solve(system, "verlet", (0, 1), y0, dt=0.01)
        assert sol.status == -1
        assert "the bond of (1, 1) and (1, 2) is nearest to a place where V is infinite" in sol.message


def test_large_systems_are_judged_by_directions():
    system = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=201)
    y0 = np.random.default_rng(2).uniform(-0.5, 0.5, 402)
    sol = sf.solve(system, "verlet", t_span=(0.0, 0.2), y0=y0, dt=0.1, backend="array")
    assert sf.symplecticity_defect(sol) < 1e-14
    with pytest.raises(ValueError, match="`directions` must be at least 3"):
        sf.symplecticity_estimate(sol, directions=2)


@pytest.mark.filterwarnings("ignore:`dt` .* is too long")
def test_symplecticity_by_random_directions_is_that_of_the_jacobians():
    """‖E‖_F/√(2d) of the worst step, of a method that is not symplectic, within four standard errors."""
    system = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=5, boundary="fixed")
    y0 = np.random.default_rng(2).uniform(-0.5, 0.5, 10)
    sol = sf.solve(system, "euler", t_span=(0.0, 0.6), y0=y0, dt=0.3)
    J = np.block([[np.zeros((5, 5)), np.eye(5)], [-np.eye(5), np.zeros((5, 5))]])
    exact = 0.0
    for _, _, A in sol.integrator.executed(system, sol.t_span, y0):
        E = np.swapaxes(A, -1, -2) @ J @ A - J
        exact = max(exact, np.linalg.norm(E, axis=(-2, -1)).max() / np.sqrt(10))
    found = sf.symplecticity_estimate(sol, directions=40)
    assert abs(found.value - exact) < 4 * found.error
    assert found.error < 0.2 * found.value


def test_other_values_of_parameters_give_another_lattice():
    system = HamiltonianSystem.lattice(**DISORDERED, y0=np.full(14, 0.1))
    other = system.with_params(b=0.7, m=np.full(7, 2.0))
    fresh = HamiltonianSystem.lattice(
        **{**DISORDERED, "params": {**DISORDERED["params"], "b": 0.7, "m": np.full(7, 2.0)}}
    )
    y = RNG.normal(size=14) * 0.5
    np.testing.assert_array_equal(other.gradient(y), fresh.gradient(y))
    np.testing.assert_array_equal(other.y0, system.y0)
    assert system.params["b"] == 0.3
    with pytest.raises(ValueError, match="`params` has 'c'"):
        system.with_params(c=1.0)
