"""Arguments that flows refuse, and what they say."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from conftest import refusals
from test_flow_driven import driven
from test_foreign_networks import GOOD, Square
from test_primed import HH, PENDULUM, RELATIVISTIC

from sympflow import Box, HamiltonianSystem, MLPFlow, SympFlow, load, solve, systems, train
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import MLPPotential, Potential, register_potential

COUPLED = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", damping=0.2, y0=[0.4, 0.3])
DAMPED, DRIVEN, OTHER_DRIVE = systems.damped_pendulum(0.3), driven(), driven(a=0.2)
FREE = HamiltonianSystem.from_sympy("p**2/2 + q**4")
FUNCTIONS = HamiltonianSystem(potential=lambda q: (q**4).sum(-1), ndof=1)
GAUSS = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", domain=Box([-1, -1], [1, 1]), y0=[0.4, 0.3])
MOVED_MASS = HamiltonianSystem.from_sympy("p**2/2*(1 + cos(t)/9) - cos(q)", time="t")
RELATIVISTIC_DAMPED = HamiltonianSystem.from_sympy("sqrt(1 + p**2) - cos(q)", damping=0.1)

of_pendulum, of_damped, of_driven = (SympFlow.primed(s, 2, dt=0.4) for s in (PENDULUM, DAMPED, DRIVEN))
timed, three = SympFlow.timed(DRIVEN, 2, hidden=(8,)), SympFlow.primed(HH, 3, dt=0.5)
still = SympFlow(2).requires_grad_(False)
potentials, layers = partial(SympFlow.from_potentials, dt=1.0), partial(SympFlow.from_layers, dt=1.0)
X, x2 = torch.zeros(3, 4, dtype=torch.float64), torch.zeros(4, 2, dtype=torch.float64)
DATA = (np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2)))
NO_H = r"^`system` must be a HamiltonianSystem, the H .* it finds no H in data\."
NOT_ITS_DRIVE = r"^`system` 'driven_pendulum' is driven, .*flow\.transferred\(system\)"
NOT_ITS_FRICTION = r"^`system` 'damped_pendulum' has friction, .*flow\.transferred\(system\)"
TIME_DEPENDS = r"is driven, H depends on t|depends on t, and flows are primed with V"

test_maps = refusals(
    (lambda: SympFlow(2).velocity(-0.1, X), r"^`t` must lie in \[0, dt\]"),
    (lambda: SympFlow(2).hamiltonian(torch.tensor([0.5, 1.5, 0.0]), X), r"^`t` must lie in \[0, dt\]"),
    (lambda: SympFlow(1)(x2[:, :1], x2), r"^`t` of shape \(4, 1\) would take every .*pass t\[\.\.\., 0\]"),
    (lambda: MLPFlow(2)(-0.5, X), "`t` must not be negative"),
    (lambda: MLPFlow(2).inverse(0.5, X), TypeError, "use a SympFlow"),
    (lambda: MLPFlow.matching(SympFlow(1, 1, (2,))), "`flow` has only 16 parameters.*use a larger flow"),
    (lambda: layers([Kick(MLPPotential(1)), Drift(MLPPotential(2))]), "`layers`"),
    (lambda: layers([]), "`layers`"),
    (lambda: three.scheme("a"), TypeError, r"^`t` must be a number in \(0, dt\] = \(0, 0.5\]; got 'a': leave it out"),
    (lambda: three.scheme(-0.5), r"^`t` must lie in \(0, dt\]"),
    (lambda: three.kernel_scheme(0.6), r"^`t` must lie in \(0, dt\] = .* got 0.6: .* several steps"),
    (lambda: of_driven(1.0, x2), TypeError, "^`t0` is missing"),
    (lambda: of_driven(1.0, x2, "now"), TypeError, "^`t0` must be a number"),
    (lambda: of_driven(1.0, x2, np.nan), "^`t0` must be finite"),
    (lambda: of_driven(1.0, x2, torch.zeros(3)), r"^`t0` of shape \(3,\) does not fit"),
    (
        lambda: of_driven.transferred(driven(period=None)).to(torch.float32)(1.0, x2.float(), 1e6),
        TypeError,
        "^`x` is torch.float32, which rounds times",
    ),
)

test_makers = refusals(
    (lambda: SympFlow.primed(None, 3), TypeError, "^`system` must be a HamiltonianSystem; got NoneType: .*from_sympy"),
    (lambda: SympFlow.split(None, 3), TypeError, "^`system` must be a HamiltonianSystem; got NoneType: .*from_sympy"),
    (lambda: SympFlow.primed(COUPLED), "^`system` .* not separable"),
    (lambda: SympFlow.primed(MOVED_MASS), TIME_DEPENDS),
    (lambda: SympFlow.primed(RELATIVISTIC_DAMPED), "has friction"),
    (lambda: SympFlow.primed(RELATIVISTIC, force_gradient=True), "^`force_gradient` needs"),
    (lambda: SympFlow.primed(RELATIVISTIC, scheme="srkn11b"), "^`scheme` 'srkn11b' needs"),
    (lambda: SympFlow.primed(RELATIVISTIC, curvature=True), "^`curvature` goes with force gradients"),
    (
        lambda: SympFlow.primed(HH, curvature=True, force_gradient=False),
        "^`curvature` goes with force gradients of a symbolic system.*`force_gradient`",
    ),
    (
        lambda: SympFlow.primed(FUNCTIONS, curvature=True),
        "^`curvature` goes with force gradients of a symbolic system.*HamiltonianSystem.from_sympy",
    ),
    (lambda: RELATIVISTIC.curvature(np.ones(1)), "^`system` .* has no curvature terms"),
    (lambda: SympFlow.split(HH, stages=0), "^`stages` must be a positive integer"),
    (lambda: SympFlow.split(HH, stages=10**6), "^`stages` must be a positive integer, at most 1000"),
    (lambda: SympFlow.split(HH, terms=0), "^`terms` must be a positive integer"),
    (lambda: SympFlow.split(HH, force_gradient=(0,), stages=3), "^`force_gradient` .* from either end"),
    (lambda: SympFlow.split(HH, stages=8, parts=("p2**2/2",)), "^`parts` do not add up"),
    (lambda: SympFlow.collocated(COUPLED), "`steps` is needed"),
    (lambda: SympFlow.collocated(GAUSS, stages=9), "`stages` must be an integer from 1 to 8; got 9"),
    (lambda: SympFlow.collocated(systems.driven_pendulum()), "depends on t"),
    (lambda: SympFlow.collocated(GAUSS, dt=1e4), "more than 200 steps"),
    (lambda: SympFlow.timed(PENDULUM), "`system` .* is not driven"),
    (lambda: SympFlow.timed(DRIVEN, harmonics=0), "`harmonics`"),
    (lambda: replace(timed.drive, period=None), "`times`"),
    (lambda: potentials([]), "^`potentials` must be "),
    (lambda: potentials([GOOD, SympFlow(2).to_potentials()[0]]), "^`potentials` must be "),
    (lambda: potentials(GOOD), TypeError, "^`potentials` must be "),
    (lambda: potentials(None), TypeError, "^`potentials` must be "),
    (lambda: layers([Kick(Square(1))]).to_potentials(), TypeError, "^`flow` has layers other than kicks and drifts"),
    (lambda: register_potential("mlp", Square), "^`name` "),
    (lambda: register_potential("", Square), "^`name` "),
    (lambda: register_potential(3, Square), TypeError, "^`name` "),
    (lambda: register_potential("other", int), TypeError, "^`potential` "),
    (lambda: register_potential("other", Potential), TypeError, r"^`potential` Potential has no from_dict\(\), which"),
    *(
        (
            lambda flag=flag, value=value: SympFlow.primed(HH, 3, **{flag: value}),
            TypeError,
            f"^`{flag}` must be True or",
        )
        for flag in ("palindromic", "force_gradient", "curvature")
        for value in ("yes", 2, "x", 1.0, [1.0])
    ),
)

test_other_systems = refusals(
    (lambda: solve(DRIVEN, of_pendulum), NOT_ITS_DRIVE),
    (lambda: train(DRIVEN, flow=of_pendulum), NOT_ITS_DRIVE),
    (lambda: solve(OTHER_DRIVE, of_driven), NOT_ITS_DRIVE),
    (lambda: solve(PENDULUM, of_driven), "is not the one that this flow was trained for"),
    (lambda: solve(driven(a=0.123), "sympflow"), "has no shipped sympflow flow"),
    (lambda: of_driven.certificate(DRIVEN), TIME_DEPENDS),
    (lambda: train(DRIVEN, flow=of_driven, loss="labels+residual"), TIME_DEPENDS),
    (lambda: train(DRIVEN, flow=of_driven, data=DATA), TIME_DEPENDS),
    (lambda: train(DRIVEN, kind="mlp"), TIME_DEPENDS),
    (lambda: solve(DRIVEN, SympFlow(1)), r"networks of SympFlow\.timed"),
    (lambda: solve(PENDULUM, timed, (0, 1)), r"no drive.*SympFlow\.timed"),
    (lambda: solve(driven(w=2 * math.pi), timed, (0, 1)), r"the period 1\.0"),
    (lambda: train(DRIVEN, harmonics=3), TypeError, r"SympFlow\.timed"),
    (lambda: solve(DAMPED, of_pendulum), NOT_ITS_FRICTION),
    (lambda: of_pendulum.check_system(DAMPED), NOT_ITS_FRICTION),
    (lambda: train(DAMPED, flow=of_pendulum), NOT_ITS_FRICTION),
    (lambda: solve(DAMPED, "sympflow", tol=1e-6), "no sympflow flow that ships was trained with it"),
    (lambda: of_damped.hamiltonian(0.1, x2), "has friction"),
    (lambda: of_damped.certificate(DAMPED), "has friction"),
    (lambda: train(DAMPED, flow=of_damped, loss="labels+matching"), "has friction"),
    (lambda: train(DAMPED, kind="sympflow"), "has friction"),
    (lambda: solve(DAMPED, SympFlow(1)), "has friction"),
    (lambda: solve(DAMPED, "sympflow", flow=of_damped, compensated=True), "^`compensated`"),
    (lambda: train(GAUSS, flow=SympFlow.collocated(GAUSS, steps=1)), "no numbers to be fitted"),
    (lambda: train(HH, flow=SympFlow.split(HH, 1), loss="residual"), "^`loss` 'residual' is not one"),
    (
        lambda: train(HH, flow=SympFlow.split(HH, 1), learning_rate=1.0),
        TypeError,
        "^`learning_rate` is not an option of the optimizer 'gauss-newton' for split",
    ),
    (lambda: train(data=DATA), TypeError, NO_H),
    (lambda: train(DATA), TypeError, NO_H),
    (lambda: train(None), TypeError, NO_H),
    (train, TypeError, NO_H),
    (lambda: MLPFlow(2).certificate(HH), TypeError, "^`flow` is an unconstrained network.*use a SympFlow"),
    (lambda: three.certificate(PENDULUM), "^`system`"),
    (lambda: SympFlow(1).certificate(FREE), "^`flow` has no domain"),
    (lambda: three.check_system(PENDULUM), "`system` .* has 1 degrees of freedom but the flow 2"),
    (lambda: solve(HH, MLPFlow(2), (0, 1), backend="compiled"), "^`backend` .* apply. `method` 'mlp'"),
)

test_files = refusals(
    (lambda: SympFlow(1).save(3), TypeError, "`path` must be the path of a file; got 3: pass"),
    (lambda: SympFlow.primed(HH).processor_scheme(), "^`flow` has no processor"),
)


def test_a_device_to_load_to_must_be_there(tmp_path):
    SympFlow(1).save(tmp_path / "flow.safetensors")
    with pytest.raises(ValueError, match=r"^`device` 'foo' is not available here .*: use device='cpu'"):
        load(tmp_path / "flow.safetensors", device="foo")
    assert load(tmp_path / "flow.safetensors", device="cpu").device == torch.device("cpu")
