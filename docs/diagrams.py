"""The two diagrams of docs/architecture.md, as SVG files that need no network and no script to be seen.

python docs/diagrams.py        writes docs/figures/rooms.svg and docs/figures/solve.svg
"""

from __future__ import annotations

from html import escape
from pathlib import Path

FIGURES = Path(__file__).parent / "figures"
WIDTH, MARGIN, GAP = 900, 20, 26  # of the picture, around it, and between two rows
LINE = 19  # height of a line of text
INK, SOFT, RULE, FILL = "#1d2433", "#5b6478", "#8a93a8", "#eef1fb"

ROOMS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("commands",), "the command line"),
    (
        ("studies", "learning", "testing", "ensembles"),
        "several runs; flows from data; checks; many orbits",
    ),
    (("training",), "fits of flows to a known H, and what ships"),
    (("metrics",), "energy, symplecticity, accuracy: of the map as executed"),
    (("solver",), "solve(): checks, picks the integrator, returns a Solution"),
    (
        ("solution", "interop"),
        "the result; SciPy, torchdiffeq, torchode: our methods there",
    ),
    (("integrators",), "scheme × splitting × clock; the driver; the registry"),
    (("flow",), "trained maps ψ̄ and their families; files; certificates"),
    (("kernels",), "compiled loops behind one protocol"),
    (("systems",), "the built-in scenes"),
    (("hamiltonian",), "H, its structure and derivatives; domains"),
    (("compiler",), "traced numbers → programs → machine code"),
    (
        ("schemes", "events", "workers", "storage"),
        "tables; zeros along a run; maps over workers; stores",
    ),
    (("show",), "cards and figures of what a user looks at"),
    (("arguments",), "checks of what users give"),
    (("arrays",), "operations that NumPy and torch spell differently"),
)
"""The rooms from the top down, as the layers of import-linter: each row imports from the rows below it only."""

SOLVE: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "solve(system, method, t_span, y0, …)",
        "",
        ("checks every argument: a Problem, and an Outcome at the end",),
    ),
    (
        "registry.build(method)",
        "a name, a class, an instance or a flow",
        ("the only place where names are looked up",),
    ),
    (
        "Integrator",
        "",
        (
            "immutable: scheme × splitting × clock, dt, options",
            "order, symplectic, check(system)",
        ),
    ),
    (
        "Stepper",
        "integrator.stepper(problem)",
        (
            "one run: its kernel or arrays, decided when it is made",
            "rollout, shorter steps; counts of evaluations",
        ),
    ),
    (
        "Run",
        "the one driver",
        (
            "walks the grid t0 + k·dt, asks the stepper for steps",
            "finds what is not finite, places outputs, finds events",
        ),
    ),
    (
        "diagnose(outcome, …)",
        "an Outcome",
        ("poles, blow-up, leaps, domain, energy: each a message or a warning",),
    ),
    (
        "Solution",
        "",
        ("t, y, status, message, stats, sol(t); each failure names its remedy",),
    ),
)
"""The way of y0 through `solve`: the box, the word on the arrow to it, and what happens there."""


def text(
    x: float,
    y: float,
    words: str,
    size: int = 14,
    colour: str = INK,
    weight: str = "normal",
) -> str:
    """A line of text that begins at (x, y)."""
    return f'<text x="{x:g}" y="{y:g}" font-size="{size}" fill="{colour}" font-weight="{weight}">{escape(words)}</text>'


def box(x: float, y: float, width: float, height: float) -> str:
    """A box with its upper left corner at (x, y)."""
    return f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6" fill="{FILL}" stroke="{RULE}"/>'


def arrow(x: float, y: float, length: float) -> str:
    """An arrow down from (x, y)."""
    return f'<path d="M {x:g} {y:g} v {length:g}" stroke="{RULE}" stroke-width="1.5" marker-end="url(#head)"/>'


def picture(title: str, height: float, parts: list[str]) -> str:
    """The SVG file."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" width="{WIDTH}" height="{height:g}" '
        f'font-family="system-ui, -apple-system, Segoe UI, Roboto, Helvetica, Arial, sans-serif" role="img">'
    )
    marker = (
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        f'<path d="M 0 0 L 8 4 L 0 8 z" fill="{RULE}"/></marker></defs>'
    )
    ground = f'<rect width="{WIDTH}" height="{height:g}" rx="8" fill="#ffffff"/>'
    return (
        "\n".join(
            [head, f"<title>{escape(title)}</title>", marker, ground, *parts, "</svg>"]
        )
        + "\n"
    )


def rooms() -> str:
    """The rooms of the package, arrows down."""
    parts, height, gap, y = [], 32, 20, float(MARGIN)
    for i, (names, words) in enumerate(ROOMS):
        x, width = float(MARGIN), 112.0
        for name in names:
            parts.append(box(x, y, width, height))
            parts.append(text(x + 10, y + 21, name, 14, INK, "600"))
            x += width + 6
        parts.append(text(498, y + 21, words, 13, SOFT))
        if i < len(ROOMS) - 1:
            parts.append(arrow(MARGIN + 46, y + height + 2, gap - 4))
        y += height + gap
    return picture("The rooms of sympflow: imports point down", y - gap + MARGIN, parts)


def solve() -> str:
    """The way of y0 through `solve`."""
    parts, y, left = [], float(MARGIN), 324.0
    for i, (name, _, lines) in enumerate(SOLVE):
        height = 20 + LINE * len(lines)
        parts.append(box(MARGIN, y, left, height))
        parts.append(text(MARGIN + 12, y + height / 2 + 5, name, 14, INK, "600"))
        parts += [
            text(MARGIN + left + 22, y + 24 + LINE * k, line, 14, SOFT)
            for k, line in enumerate(lines)
        ]
        if i < len(SOLVE) - 1:
            parts.append(arrow(MARGIN + 60, y + height + 2, GAP + 2))
            following = SOLVE[i + 1][1]
            if following:
                parts.append(text(MARGIN + 74, y + height + 20, following, 12, SOFT))
        y += height + GAP + 8
    return picture("The way of y0 through solve", y - GAP - 8 + MARGIN, parts)


def main() -> None:
    for name, drawn in (("rooms", rooms()), ("solve", solve())):
        (FIGURES / f"{name}.svg").write_text(drawn, encoding="utf-8")


if __name__ == "__main__":
    main()
