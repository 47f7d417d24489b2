"""The checks that every integrator must pass, ours and those of third parties."""

from sympflow.testing.checks import check_integrator

__all__ = ["check_integrator"]
