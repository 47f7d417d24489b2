"""Outputs on pages and in the notebook, as `python docs/outputs.py` writes them.

A ```text block after a ```python block holds what this prints; a test compares them.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parent
PAGES = ("getting-started.md",)
NOTEBOOK = DOCS / "tutorial.ipynb"
PAIR = re.compile(
    r"^```python\n(?P<code>.*?)^```$(?P<shown>\n\n```text\n(?P<output>.*?)^```$)?",
    re.M | re.S,
)


@contextlib.contextmanager
def elsewhere():
    """Run in an empty folder, with figures drawn into nothing."""
    before = Path.cwd()
    os.environ.setdefault("MPLBACKEND", "agg")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


def printed(code: str, names: dict[str, object]) -> str:
    """What a block prints, in a namespace."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(code, "<page>", "exec"), names)
    return out.getvalue()


def page_with_outputs(text: str) -> str:
    """A page whose outputs are those of its code as it runs now."""
    names: dict[str, object] = {"__name__": "page"}

    def fill(block: re.Match[str]) -> str:
        output = printed(block["code"], names)
        code = f"```python\n{block['code']}```"
        return code if block["shown"] is None else f"{code}\n\n```text\n{output}```"

    with elsewhere():
        return PAIR.sub(fill, text)


def notebook_with_outputs(notebook: dict) -> dict:
    """A notebook whose outputs are those of its cells as they run now."""
    names: dict[str, object] = {"__name__": "notebook"}
    with elsewhere():
        for number, cell in enumerate(
            (c for c in notebook["cells"] if c["cell_type"] == "code"), start=1
        ):
            output = printed("".join(cell["source"]), names)
            stream = {
                "name": "stdout",
                "output_type": "stream",
                "text": output.splitlines(keepends=True),
            }
            cell |= {"execution_count": number, "outputs": [stream] if output else []}
    return notebook


def as_page(notebook: dict) -> str:
    """A notebook as a page of the site."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(
            source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```"
        )
        parts += [
            f"```text\n{''.join(out['text'])}```" for out in cell.get("outputs", ())
        ]
    return "\n\n".join(parts)


def on_page_markdown(markdown: str, page, **_: object) -> str:
    """The notebook in place of the page that bears its name. Called by mkdocs."""
    if page.file.src_uri != "tutorial.md":
        return markdown
    return f"{markdown}\n\n{as_page(json.loads(NOTEBOOK.read_text(encoding='utf-8')))}"


if __name__ == "__main__":
    for name in sys.argv[1:] or PAGES:
        path = DOCS / name
        path.write_text(
            page_with_outputs(path.read_text(encoding="utf-8")), encoding="utf-8"
        )
    content = notebook_with_outputs(json.loads(NOTEBOOK.read_text(encoding="utf-8")))
    NOTEBOOK.write_text(
        json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
