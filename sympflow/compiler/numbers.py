"""The numbers of a stage. One kind of number, one interpretation of its operations.

A stage is a Python function that uses operators and the functions of `functions`. Called with NumPy arrays or tensors
it computes; called with numbers of a kind of its own it records a program, writes machine code, expands polynomials.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["Number"]


class Number:
    """A number of a kind: a subclass defines in `apply` the operations of its numbers and floats."""

    __slots__ = ()
    __array_ufunc__ = None  # NumPy leaves the operators to this class

    def apply(self, name: str, args: Sequence[Any]) -> Any:
        """Return the value of the function `name` of the table; this number is one of the arguments."""
        raise NotImplementedError(f"{type(self).__name__} must define apply().")

    def __add__(self, other: Any) -> Any:
        return self.apply("add", (self, other))

    def __radd__(self, other: Any) -> Any:
        return self.apply("add", (other, self))

    def __sub__(self, other: Any) -> Any:
        return self.apply("sub", (self, other))

    def __rsub__(self, other: Any) -> Any:
        return self.apply("sub", (other, self))

    def __mul__(self, other: Any) -> Any:
        return self.apply("mul", (self, other))

    def __rmul__(self, other: Any) -> Any:
        return self.apply("mul", (other, self))

    def __truediv__(self, other: Any) -> Any:
        return self.apply("div", (self, other))

    def __rtruediv__(self, other: Any) -> Any:
        return self.apply("div", (other, self))

    def __pow__(self, other: Any) -> Any:
        return self.apply("pow", (self, other))

    def __rpow__(self, other: Any) -> Any:
        return self.apply("pow", (other, self))

    def __neg__(self) -> Any:
        return self.apply("neg", (self,))

    def __pos__(self) -> Any:
        return self

    def __abs__(self) -> Any:
        return self.apply("abs", (self,))

    def __lt__(self, other: Any) -> Any:
        return self.apply("lt", (self, other))

    def __le__(self, other: Any) -> Any:
        return self.apply("le", (self, other))

    def __gt__(self, other: Any) -> Any:
        return self.apply("lt", (other, self))

    def __ge__(self, other: Any) -> Any:
        return self.apply("le", (other, self))

    def __and__(self, other: Any) -> Any:
        return self.apply("and", (self, other))

    def __or__(self, other: Any) -> Any:
        return self.apply("or", (self, other))

    def __invert__(self) -> Any:
        return self.apply("not", (self,))

    def __bool__(self) -> bool:
        raise TypeError("a number that is traced has no value yet: write where(condition, a, b) in place of a branch.")

    def __float__(self) -> float:
        raise TypeError("a number that is traced has no value yet: write np.cos for math.cos, and no float().")

    __int__ = __index__ = __float__


_OF_NUMPY = {
    **{name: name for name in ("exp", "expm1", "log", "log1p", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"arc{name}": f"a{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
}
for _name, _function in _OF_NUMPY.items():  # which loops of NumPy over objects call
    setattr(Number, _name, lambda self, _function=_function: self.apply(_function, (self,)))
