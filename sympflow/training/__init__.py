"""Training of flows: `train`, and the fits and solvers whose fields are its options."""

from typing import TYPE_CHECKING, Any

from sympflow.lazy import whole_import

_HOME = {
    "train": "trainer",
    **dict.fromkeys(("PrimedFit", "SplitFit", "NetworkFit", "LossFit", "ClockedFit", "KeplerFit"), "fits"),
    **dict.fromkeys(("GaussNewton", "Adam", "BFGS", "LBFGS"), "fits"),
}
__all__ = [*_HOME]  # noqa: PLE0604

if TYPE_CHECKING:
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


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(whole_import(f"{__name__}.{_HOME[name]}"), name)
