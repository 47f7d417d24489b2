"""Training: the losses, the improvement, resumption to the bit, and how a run ends."""

import math
import subprocess
import sys
import textwrap
import zipfile

import numpy as np
import pytest
import torch

import sympflow
from sympflow.flow.mlp import MLPFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Box
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.systems import harmonic_oscillator, henon_heiles
from sympflow.training import checkpoint as checkpoints
from sympflow.training.losses import Loss
from sympflow.training.optimizers import BFGSSteps, LBFGSSteps
from sympflow.training.points import Points, PointSource, Stream, states
from sympflow.training.trainer import train

QUICK = {"pairs": 1, "hidden": (5,), "points": 60, "validation_points": 60, "reference_states": 5, "progress": False}
CPU = torch.device("cpu")


def weights(flow):
    return torch.cat([w.reshape(-1) for w in flow.state_dict().values()])


class Rotation(SympFlow):
    """The exact flow of the harmonic oscillator, as a SympFlow in what the losses ask of it."""

    def __init__(self):
        super().__init__(1, pairs=1)

    def psi_and_velocity(self, t, x):
        c, s, (q, p) = torch.cos(t), torch.sin(t), x.unbind(-1)
        y = torch.stack([c * q + s * p, c * p - s * q], -1)
        return y, torch.stack([y[..., 1], -y[..., 0]], -1)

    def hamiltonian_unchecked(self, t, x):
        return x.square().sum(-1) / 2 + torch.sin(7 * t)  # 𝓗 is free up to c(t)


def points(n=50, ndof=1, dt=1.0):
    return PointSource(Box([-1.0] * 2 * ndof, [1.0] * 2 * ndof), dt, n, 5, 0, torch.float64, CPU, block=2)(0)


def test_losses_vanish_for_the_exact_flow():
    loss = Loss(harmonic_oscillator(), Scaling.unit(1))
    L1, L2, L3 = loss.terms(Rotation(), points())
    assert L3 is None
    assert L1 < 1e-30
    assert L2 < 1e-30


def test_losses_are_the_papers():
    """Against the definitions, written out with autodiff, on a random flow."""
    system, flow, sample = henon_heiles(), SympFlow(2, seed=4), points(ndof=2)
    L1, L2, _ = Loss(system, Scaling.unit(2)).terms(flow, sample)
    t, x = sample.residual
    y, dy = torch.func.jvp(lambda t: flow.psi(t, x), (t,), (torch.ones_like(t),))
    torch.testing.assert_close(L1, (dy - system.vector_field(y)).square().sum(-1).mean())
    difference = flow.hamiltonian(*sample.matching) - system.hamiltonian(sample.matching[1])
    torch.testing.assert_close(L2, difference.var(1, correction=0).mean())


def test_losses_do_not_depend_on_units():
    """The oscillator at ω = 100 and Δt = 0.01 trains as the one at ω = 1 and Δt = 1."""
    omega, sample, losses = 100.0, points(), []
    for w in (1.0, omega):
        scaling = Scaling((1.0,), (w,), 1 / w)
        flow = SympFlow(1, dt=1 / w, scale=scaling, seed=3)
        unit = torch.tensor([1.0, w], dtype=torch.float64)
        scaled = Points(*((t / w, x * unit) for t, x in (sample.residual, sample.matching)))
        losses.append(torch.stack(Loss(harmonic_oscillator(w), scaling).terms(flow, scaled)[:2]))
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-10, atol=0)


# what training does ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sympflow", "mlp"])
@pytest.mark.parametrize(("optimizer", "steps"), [("adam", 150), ("bfgs", 4), ("lbfgs", 6), ("gauss-newton", 30)])
def test_training_improves(kind, optimizer, steps):
    options = {"learning_rate": 2e-2} if optimizer == "adam" else {"points": 300}
    flow = train(harmonic_oscillator(), kind=kind, optimizer=optimizer, steps=steps, **{**QUICK, **options})
    first, last = flow.history[0], flow.history[-1]
    assert isinstance(flow, MLPFlow if kind == "mlp" else SympFlow)
    assert last["loss"] < first["loss"] / 3
    assert last["one_step_error"] < first["one_step_error"] / 2
    assert flow.figures["one_step_error"] == min(flow.history, key=lambda f: f["loss"])["one_step_error"]
    assert not any(w.requires_grad for w in flow.parameters())
    assert flow.domain == harmonic_oscillator().domain
    flow.check_system(harmonic_oscillator())


# resumption ----------------------------------------------------------------------------------------------------


class Killed(Exception):
    pass


def test_resuming_another_run_is_refused(tmp_path):
    path, system = tmp_path / "run.ckpt", harmonic_oscillator()
    train(system, steps=10, checkpoint=path, **QUICK)
    for changed, message in (
        ({"steps": 20}, "`resume` is a run with another steps"),
        ({"steps": 10, "learning_rate": 1.0, "seed": 2}, "another learning_rate, seed"),
        ({"steps": 10, "kind": "mlp", "matching_weight": 0.0}, "another"),
    ):
        with pytest.raises(ValueError, match=message):
            train(system, resume=path, **{**QUICK, **changed})
    far = sympflow.HamiltonianSystem.from_sympy("p**2/2 + q**2/2 + Max(q - 40, 0)**4", domain=system.domain)
    for other in (harmonic_oscillator(2.0), far):
        with pytest.raises(ValueError, match="another system"):
            train(other, resume=path, steps=10, **QUICK)


@pytest.mark.parametrize("content", [b"", b"junk", None])
def test_what_is_not_a_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "run.ckpt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"`resume` .* is not a"):
        train(harmonic_oscillator(), resume=path, steps=10, **QUICK)


def test_a_checkpoint_is_never_unpickled(tmp_path):
    path = tmp_path / "run.ckpt"
    torch.save({"format": 1, "config": Killed()}, path)
    with pytest.raises(ValueError, match=r"`resume` .* is not a checkpoint"):
        checkpoints.read(path)


def test_a_packed_checkpoint_is_refused(tmp_path):
    """A small file may unpack to any size."""
    torch.save({"format": 1}, tmp_path / "whole")
    with zipfile.ZipFile(tmp_path / "whole") as whole, zipfile.ZipFile(tmp_path / "packed", "w", 8) as packed:
        for name in whole.namelist():
            packed.writestr(name, whole.read(name))
    with pytest.raises(ValueError, match=r"`resume` .* is not a checkpoint \(ValueError\)"):
        checkpoints.read(tmp_path / "packed")


# how a run ends ------------------------------------------------------------------------------------------------


def test_a_loss_that_is_not_finite_ends_the_run_with_the_best_state():
    overshoot = {"learning_rate": 1e200, "clip": None, "schedule": "constant", "validate_every": 1}
    with pytest.warns(RuntimeWarning, match="the loss was not finite at step"):
        flow = train(harmonic_oscillator(), steps=50, **overshoot, **QUICK)
    assert torch.isfinite(weights(flow)).all()
    assert math.isfinite(flow.figures["residual_loss"])


def test_a_loss_that_is_not_finite_from_the_start_is_an_error():
    system = HamiltonianSystem.from_sympy("p**2/2 + log(q)", domain=Box([-2.0, -1.0], [-1.0, 1.0]))
    with pytest.raises(FloatingPointError, match="not finite at the first validation"):
        train(system, steps=5, residual_weight=0.0, **QUICK)


# bad arguments ---------------------------------------------------------------------------------------------------


def test_a_system_without_a_domain_says_what_to_pass():
    system = HamiltonianSystem.from_sympy("p**2/2 + q**4/4")
    with pytest.raises(ValueError, match=r"`domain` .*sympflow\.Box"):
        train(system)
    assert train(system, domain=Box([-1.0, -1.0], [1.0, 1.0]), steps=2, **QUICK).domain == Box([-1.0, -1.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="`domain` has states of length 4"):
        train(system, domain=Box([-1.0] * 4, [1.0] * 4))


# optimizers --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [BFGSSteps, LBFGSSteps])
def test_quasi_newton_methods_find_a_minimum(method):
    """The Rosenbrock valley, a step at a time, to rounding."""
    module = torch.nn.Module()
    module.x = torch.nn.Parameter(torch.tensor([-1.2, 1.0], dtype=torch.float64))
    module.n_parameters = 2
    method = method(module)

    def rosenbrock():
        x, y = module.x
        return (1 - x) ** 2 + 100 * (y - x**2) ** 2

    for k in range(5):
        method.step(k, rosenbrock)
    torch.testing.assert_close(module.x.detach(), torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-8)


def test_points_are_a_function_of_seed_and_step():
    domain = henon_heiles().domain

    def source(seed):
        return PointSource(domain, 0.5, 40, 4, seed, torch.float64, CPU, block=4)

    one, other = source(0), source(0)
    t, x = one(9).residual
    assert torch.equal(x, other(9).residual[1])
    one(3)
    assert torch.equal(one(9).residual[0], t)
    for another in (one(8), source(1)(9)):
        assert not torch.equal(another.residual[1], x)
    sample = one(9)
    assert domain.contains(x).all()
    assert [a.shape for a in sample.matching] == [(4, 1), (4, 10, 4)]
    assert 0 <= t.min() < t.max() <= 0.5
    assert not np.array_equal(states(domain, 3, 0, Stream.RESIDUAL), states(domain, 3, 0, Stream.VALIDATION))


def test_a_killed_process_resumes_bit_identical(tmp_path):
    """A real process, ended by SIGKILL in the middle."""
    path = tmp_path / "run.ckpt"
    program = textwrap.dedent(
        """
        import os, signal, sys
        from sympflow.systems import harmonic_oscillator
        from sympflow.training.trainer import train

        def kill(step, figures):
            if step == 30:
                os.kill(os.getpid(), signal.SIGKILL)

        train(harmonic_oscillator(), steps=40, validate_every=10, checkpoint=sys.argv[1], checkpoint_every=7,
              callback=kill, pairs=1, hidden=(5,), points=60, validation_points=60, reference_states=5)
        """
    )
    run = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, check=False)
    assert run.returncode == -9, run.stderr.decode()
    arguments = {"steps": 40, "validate_every": 10, **QUICK}
    resumed = train(harmonic_oscillator(), resume=path, **arguments)
    assert torch.equal(weights(resumed), weights(train(harmonic_oscillator(), **arguments)))
    assert [p.name for p in tmp_path.iterdir()] == ["run.ckpt"]


def test_a_system_that_is_not_separable():
    def hamiltonian(q, p):
        return ((1 + q.square()) * p.square()).sum(-1) / 2 + q.square().sum(-1) / 2

    system = HamiltonianSystem(hamiltonian=hamiltonian, ndof=1, domain=Box([-1.0, -1.0], [1.0, 1.0]))
    flow = train(system, 0.5, optimizer="bfgs", steps=3, **QUICK)
    assert flow.history[-1]["loss"] < flow.history[0]["loss"] / 4
    A = torch.autograd.functional.jacobian(lambda x: flow(3.2, x), torch.tensor([0.4, 0.3], dtype=torch.float64))
    assert torch.linalg.det(A).item() == pytest.approx(1, abs=1e-13)


def test_a_weight_of_zero_leaves_a_loss_out():
    flow, system, sample = SympFlow(1), harmonic_oscillator(), points()
    L1, L2, _ = Loss(system, Scaling.unit(1), 2.0, 0.0).terms(flow, sample)
    assert L2 is None
    assert Loss(system, Scaling.unit(1), 2.0, 0.0)(flow, sample) == 2 * L1
    L1, L2, _ = Loss(system, Scaling.unit(1), 0.0, 3.0).terms(flow, sample)
    assert L1 is None
    assert Loss(system, Scaling.unit(1), 0.0, 3.0)(flow, sample) == 3 * L2
