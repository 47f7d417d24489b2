"""The flows that ship: measured again, and held against what the issue asks of them."""

import pytest
import torch

from sympflow import max_energy_error, solve, systems, train
from sympflow.flow.mlp import MLPFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.training import pretrained
from sympflow.training.fits import GaussNewton, LossFit, NetworkFit
from sympflow.training.shipped.recipe import INITIAL, Recipe

KINDS = ("sympflow", "mlp")
PENDULUM = systems.pendulum()


def recipe_of(scene, kind="sympflow"):
    return Recipe.of(pretrained.package_folder() / f"{scene}-{kind}.safetensors")


def measured(recipe, flow, **options):
    return recipe.judge.measured(flow, recipe.system, **options)


# error of one step and of the energy over 1000 steps, as `measured` defines them: level with the published checkpoints
TARGETS = {
    "harmonic_oscillator": (3.5e-4, 1.9e-3),
    "henon_heiles": (2.3e-3, 1.4e-3),
    "pendulum": (2.3e-3, 1.4e-3),
    "harmonic_oscillator_100": (3.5e-4, 1.9e-3),
}


@pytest.mark.parametrize("scene", INITIAL)
def test_shipped_sympflows_reach_their_targets(scene):
    """And the figures that their files hold are what they achieve."""
    recipe = recipe_of(scene)
    flow, figures = recipe.flow, measured(recipe, recipe.flow)
    one_step, energy = TARGETS[scene]
    assert figures["error_1"] <= one_step
    assert figures["energy_error"] <= energy * recipe.judge.omega**2
    # Over many steps a chaotic orbit depends on the rounding, and so on the machine.
    for name, value in figures.items():
        assert flow.figures[name] == pytest.approx(value, rel=1e-3 if name in ("error_1", "error_10") else 0.5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", INITIAL)
def test_shipped_networks_are_those_of_their_recipes(name, kind):
    recipe = recipe_of(name, kind)
    system, flow = recipe.system, recipe.flow
    assert isinstance(flow, {"sympflow": SympFlow, "mlp": MLPFlow}[kind])
    assert flow.domain.attach(system.hamiltonian).contains(recipe.judge.initial()).all()
    assert [stage["optimizer"] for stage in flow.recipe["stages"]] in (["gauss-newton"] * 2, ["adam", "bfgs"])
    assert recipe.path.stat().st_size < 25_000


def test_a_network_is_made_again_by_its_file(tmp_path):
    domain = PENDULUM.domain
    fit, further = NetworkFit(1.0, pairs=2, hidden=(4,), points=40), LossFit(points=50, seed=1)
    flow = train(PENDULUM, fit, solver=GaussNewton(2), domain=domain, progress=False)
    flow = train(PENDULUM, further, flow=flow, solver=GaussNewton(1), domain=domain, progress=False)
    flow.save(tmp_path / "pendulum-sympflow.safetensors")
    again = Recipe.of(tmp_path / "pendulum-sympflow.safetensors").fitted(progress=False)
    assert [(stage["points"], stage["steps"]) for stage in again.recipe["stages"]] == [(40, 2), (50, 1)]
    assert all(torch.equal(w, flow.state_dict()[name]) for name, w in again.state_dict().items())


@pytest.mark.parametrize("scene", INITIAL)
def test_shipped_sympflows_stay_for_a_hundred_thousand_steps(scene):
    """No neuron has a slope that the figures, of 1000 steps, do not see, but a long orbit meets."""
    recipe = recipe_of(scene)
    system, flow = recipe.system, recipe.flow
    y0 = [0.0, 0.1, 0.35, 0.0] if scene == "henon_heiles" else system.y0  # a regular orbit
    sol = solve(system, flow, (0.0, 1e5 * flow.dt), y0=y0, save_every=100, on_domain_exit="ignore")
    assert max_energy_error(sol) <= 1e-4
