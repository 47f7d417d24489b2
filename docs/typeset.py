"""Formulas of the site: TeX between dollar signs becomes MathML in the build, so that a page needs no script for it.

mkdocs.yml names this file as a hook. Pages are read first by `pymdownx.arithmatex`, which keeps Markdown off the TeX.
"""

from __future__ import annotations

import html
import re
from typing import TYPE_CHECKING

from math_core import LatexError, LatexToMathML

if TYPE_CHECKING:
    from mkdocs.structure.pages import Page

FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<opening>[(\[])(?P<tex>.*?)\\[)\]]</(?P=tag)>',
    re.DOTALL,
)


def mathml(tex: str, display: bool = False) -> str:
    """MathML of a formula; a ValueError says what is wrong with it."""
    try:
        return LatexToMathML().convert_with_local_state(tex, displaystyle=display)
    except LatexError as error:
        raise ValueError(f"{tex}: {error}") from error


def on_page_content(content: str, page: Page, **_: object) -> str:
    """The page with its formulas typeset. Called by mkdocs."""

    def typeset(formula: re.Match[str]) -> str:
        display = formula["opening"] == "["
        try:
            math = mathml(html.unescape(formula["tex"]), display)
        except ValueError as error:
            raise ValueError(f"{page.file.src_uri}: {error}") from error
        return f'<div class="formula">{math}</div>' if display else math

    return FORMULA.sub(typeset, content)
