"""Pictures of the gallery: runs the code on docs/gallery.md and saves what each block has drawn.

python docs/gallery.py              all pictures, in a minute or two
python docs/gallery.py pendulum     one of them
"""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path

PAGE = Path(__file__).parent / "gallery.md"
PICTURES = PAGE.parent / "figures" / "gallery"
BLOCK = re.compile(
    r"^(?:!\[[^\]]*\]\(figures/gallery/(?P<picture>[^)]+)\)\n\n)?```python\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
STYLE = {  # on white as on black
    "figure.figsize": (6.4, 4.0),
    "figure.dpi": 140,
    "figure.constrained_layout.use": True,
    "savefig.transparent": True,
    "text.color": "#808890",
    "axes.labelcolor": "#808890",
    "axes.edgecolor": "#808890",
    "xtick.color": "#808890",
    "ytick.color": "#808890",
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def draw(wanted: set[str]) -> None:
    """Run the blocks in order, in one namespace, and save those whose picture is wanted."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(STYLE)
    page: dict[str, object] = {}
    for block in BLOCK.finditer(PAGE.read_text(encoding="utf-8")):
        path = PICTURES / (block["picture"] or "")
        if wanted and block["picture"] and path.stem not in wanted:
            continue
        start = time.perf_counter()
        exec(block["code"], page)
        if block["picture"]:
            save(plt.gcf(), path)
            plt.close("all")
            print(
                f"{path.stem}: {time.perf_counter() - start:.1f} s, {path.stat().st_size / 1024:.0f} KiB"
            )


def save(figure: object, path: Path) -> None:
    """A PNG of 256 colours, a third as large as one of all colours."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.open(buffer).quantize(256, method=Image.Quantize.FASTOCTREE).save(
        path, optimize=True
    )


if __name__ == "__main__":
    draw(set(sys.argv[1:]))
