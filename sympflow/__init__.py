"""Structure-preserving integration of Hamiltonian systems, classical and learned, behind one interface.

The public names are loaded when first used (PEP 562): importing sympflow loads neither torch, SciPy nor matplotlib.
"""

from importlib import import_module
from types import FunctionType
from typing import TYPE_CHECKING, Any

from sympflow._version import __version__
from sympflow.lazy import whole_import

_HOME = {
    "HamiltonianSystem": "hamiltonian.system",
    "Ball": "hamiltonian.domain",
    "Box": "hamiltonian.domain",
    "EnergySublevel": "hamiltonian.domain",
    "LatticeStates": "hamiltonian.lattice_states",
    "Tube": "hamiltonian.domain",
    "time_transformed": "hamiltonian.time_transformation",
    "doubled": "hamiltonian.doubling",
    "solve": "solver",
    "choose_step": "integrators.choosing",
    "ensemble": "ensembles.sweep",
    "Solution": "solution",
    "Interrupted": "integrators.contract",
    "get": "integrators.registry",
    "available": "integrators.registry",
    "register": "integrators.registry",
    "Scheme": "schemes",
    "splitting_method": "integrators.splitting",
    "SympFlow": "flow.sympflow",
    "MLPFlow": "flow.mlp",
    "load": "flow.files",
    "shipped_flows": "flow.shipped",
    "train": "training.trainer",
    "PrimedFit": "training.fits",
    "SplitFit": "training.fits",
    "NetworkFit": "training.fits",
    "LossFit": "training.fits",
    "ClockedFit": "training.fits",
    "KeplerFit": "training.fits",
    "GaussNewton": "training.fits",
    "Adam": "training.fits",
    "BFGS": "training.fits",
    "LBFGS": "training.fits",
    "discover": "learning.discovery",
    "learn": "learning.learner",
    "Trajectories": "learning.trajectories",
    "compare": "studies.comparison",
    "work_precision": "studies.precision",
    "stability": "studies.step_stability",
    "poincare_section": "studies.poincare",
    "energy_error": "metrics.energy",
    "max_energy_error": "metrics.energy",
    "angular_momentum": "metrics.elements",
    "elements": "metrics.elements",
    "momentum": "metrics.elements",
    "states_of_elements": "metrics.elements",
    "energy_drift": "metrics.energy",
    "energy_growth": "metrics.energy",
    "energy_balance_error": "metrics.energy_balance",
    "volume_error": "metrics.symplectic",
    "symplecticity_defect": "metrics.symplectic",
    "symplecticity_estimate": "metrics.symplectic",
    "conformal_defect": "metrics.symplectic",
    "loop_area_error": "metrics.symplectic",
    "floquet_multipliers": "metrics.floquet",
    "linear_stability": "metrics.linear_stability",
    "lyapunov": "metrics.chaos",
    "sali": "metrics.chaos",
    "gali": "metrics.chaos",
    "frequencies": "metrics.frequencies",
    "escape_times": "metrics.escapes",
    "reference_error": "metrics.accuracy",
    "time_reversal_error": "metrics.accuracy",
}
_MODULES = ("systems", "interop")
_ROOMS = (
    "ensembles",
    "flow",
    "hamiltonian",
    "integrators",
    "learning",
    "metrics",
    "schemes",
    "storage",
    "studies",
    "testing",
    "training",
)

__all__ = ["__version__", *_HOME, *_MODULES]  # noqa: PLE0604

if TYPE_CHECKING:
    from sympflow import interop as interop
    from sympflow import systems as systems
    from sympflow.ensembles.sweep import ensemble as ensemble
    from sympflow.flow.files import load as load
    from sympflow.flow.mlp import MLPFlow as MLPFlow
    from sympflow.flow.shipped import shipped_flows as shipped_flows
    from sympflow.flow.sympflow import SympFlow as SympFlow
    from sympflow.hamiltonian.domain import Ball as Ball
    from sympflow.hamiltonian.domain import Box as Box
    from sympflow.hamiltonian.domain import EnergySublevel as EnergySublevel
    from sympflow.hamiltonian.domain import Tube as Tube
    from sympflow.hamiltonian.doubling import doubled as doubled
    from sympflow.hamiltonian.lattice_states import LatticeStates as LatticeStates
    from sympflow.hamiltonian.system import HamiltonianSystem as HamiltonianSystem
    from sympflow.hamiltonian.time_transformation import time_transformed as time_transformed
    from sympflow.integrators.choosing import choose_step as choose_step
    from sympflow.integrators.contract import Interrupted as Interrupted
    from sympflow.integrators.registry import available as available
    from sympflow.integrators.registry import get as get
    from sympflow.integrators.registry import register as register
    from sympflow.integrators.splitting import splitting_method as splitting_method
    from sympflow.learning.discovery import discover as discover
    from sympflow.learning.learner import learn as learn
    from sympflow.learning.trajectories import Trajectories as Trajectories
    from sympflow.metrics.accuracy import reference_error as reference_error
    from sympflow.metrics.accuracy import time_reversal_error as time_reversal_error
    from sympflow.metrics.chaos import gali as gali
    from sympflow.metrics.chaos import lyapunov as lyapunov
    from sympflow.metrics.chaos import sali as sali
    from sympflow.metrics.elements import angular_momentum as angular_momentum
    from sympflow.metrics.elements import elements as elements
    from sympflow.metrics.elements import momentum as momentum
    from sympflow.metrics.elements import states_of_elements as states_of_elements
    from sympflow.metrics.energy import energy_drift as energy_drift
    from sympflow.metrics.energy import energy_error as energy_error
    from sympflow.metrics.energy import energy_growth as energy_growth
    from sympflow.metrics.energy import max_energy_error as max_energy_error
    from sympflow.metrics.energy_balance import energy_balance_error as energy_balance_error
    from sympflow.metrics.escapes import escape_times as escape_times
    from sympflow.metrics.floquet import floquet_multipliers as floquet_multipliers
    from sympflow.metrics.frequencies import frequencies as frequencies
    from sympflow.metrics.linear_stability import linear_stability as linear_stability
    from sympflow.metrics.symplectic import conformal_defect as conformal_defect
    from sympflow.metrics.symplectic import loop_area_error as loop_area_error
    from sympflow.metrics.symplectic import symplecticity_defect as symplecticity_defect
    from sympflow.metrics.symplectic import symplecticity_estimate as symplecticity_estimate
    from sympflow.metrics.symplectic import volume_error as volume_error
    from sympflow.schemes import Scheme as Scheme
    from sympflow.solution import Solution as Solution
    from sympflow.solver import solve as solve
    from sympflow.studies.comparison import compare as compare
    from sympflow.studies.poincare import poincare_section as poincare_section
    from sympflow.studies.precision import work_precision as work_precision
    from sympflow.studies.step_stability import stability as stability
    from sympflow.training.fits import BFGS as BFGS
    from sympflow.training.fits import LBFGS as LBFGS
    from sympflow.training.fits import Adam as Adam
    from sympflow.training.fits import ClockedFit as ClockedFit
    from sympflow.training.fits import GaussNewton as GaussNewton
    from sympflow.training.fits import KeplerFit as KeplerFit
    from sympflow.training.fits import LossFit as LossFit
    from sympflow.training.fits import NetworkFit as NetworkFit
    from sympflow.training.fits import PrimedFit as PrimedFit
    from sympflow.training.fits import SplitFit as SplitFit
    from sympflow.training.trainer import train as train

_OF_INTEROP = {"as_scipy": "scipy", "from_hamiltonian": "systems", "from_module": "systems"} | dict.fromkeys(
    ("odeint", "odeint_adjoint", "odeint_dense", "odeint_event"), "torchdiffeq"
)

_ELSEWHERE = {
    **dict.fromkeys(("plot", "plotting", "visualization"), "plots are methods of results, such as solve(…).plot()"),
    **dict.fromkeys(("chaos", "analysis"), "take lyapunov, sali, frequencies or poincare_section, all in `sympflow`"),
    **dict.fromkeys(("methods", "solvers"), "take available(), which lists them, or get(name)"),
}


def __getattr__(name: str) -> Any:
    if name in (*_MODULES, *_ROOMS):
        return import_module(f"sympflow.{name}")
    if name not in _HOME:
        from difflib import get_close_matches

        close = [] if name.startswith("_") else get_close_matches(name, (*_HOME, *_MODULES, *_ROOMS), 1)
        hint = f". Did you mean {close[0]!r}?" if close else ""
        if not name.startswith("_") and name in whole_import("sympflow.systems").__all__:
            hint = f". It is `sympflow.systems.{name}`"
        if name in _ELSEWHERE:
            hint = f": {_ELSEWHERE[name]}"
        if name in _OF_INTEROP:
            hint = f". It is `sympflow.interop.{_OF_INTEROP[name]}.{name}`"
        raise AttributeError(f"module 'sympflow' has no attribute {name!r}{hint}")
    value = getattr(whole_import(f"sympflow.{_HOME[name]}"), name)
    if isinstance(value, FunctionType):
        from sympflow.arguments import told

        value = told(value)
        value.__module__ = __name__  # where pickles find it
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
