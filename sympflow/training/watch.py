"""Watch: what goes beside trials, from the line that says what is tried to the flows that they leave."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from sympflow.flow.primed import PrimedFlow
from sympflow.training.interruption import Interruption
from sympflow.training.progress import progress
from sympflow.training.recipes import PrimedRecipe


@dataclass
class Watch:
    """Over trials of recipes.

    Parameters
    ----------
    interruption : Interruption
        Which may end them, once there is a flow.
    show : bool, optional
        Whether to say what is tried; None means on a terminal only.

    Attributes
    ----------
    flows : dict
        By their recipes those with a table that a trial fitted.
    """

    interruption: Interruption = field(default_factory=Interruption)
    show: bool | None = False
    flows: dict[PrimedRecipe, PrimedFlow] = field(default_factory=dict, init=False)

    def bar(self, total: int, label: str) -> Any:
        """What shows so many trials."""
        return progress(self.show, total, label)

    def stopped(self) -> bool:
        """Whether the trials are to end; the present one then says nothing."""
        return self.interruption.asked

    def arm(self) -> None:
        """From now on Ctrl-C ends the trials, if there is a flow."""
        self.interruption.armed = bool(self.flows)
