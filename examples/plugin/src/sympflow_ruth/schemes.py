"""Ruth's symplectic method of order three as a table: it runs compiled, with every splitting and clock."""

from sympflow import Scheme

RUTH3 = Scheme(
    "ruth3",
    order=3,
    kicks=(7 / 24, 3 / 4, -1 / 24),
    drifts=(2 / 3, -2 / 3, 1.0),
    source="R. D. Ruth, A canonical integration technique, IEEE Trans. Nucl. Sci. 30 (1983) 2669–2671",
)
