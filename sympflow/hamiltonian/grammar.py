"""The grammar of formulas: a text as a tree of numbers, names, + − * / **, calls and comparisons, never executed."""

from __future__ import annotations

import ast
import keyword
import re
from collections.abc import Container

MAX_TEXT = 100_000  # characters
MAX_NESTING = 100  # brackets and powers in each other
TERMS_IN_A_ROW = 200


COORDINATE = re.compile(r"[qp]([1-9][0-9]{0,15})?")


class Unreadable(ValueError):
    """Refusal of a text, with the reason as a clause."""


def parsed(text: str, functions: Container[str]) -> ast.expr:
    """The tree of a text, in which names of functions are known for what remedies say."""
    if len(text) > MAX_TEXT:
        raise Unreadable(
            f"it has {len(text):,} characters, more than {MAX_TEXT:,}: a system that large is better given by one site "
            "and one bond, HamiltonianSystem.lattice, by one pair, HamiltonianSystem.pairs, or by Numba functions, "
            "HamiltonianSystem(V, ndof=…, gradient=…)"
        )
    _check_characters(text)
    try:
        return ast.parse(_grouped(" ".join(text.replace("^", "**").split())), mode="eval").body
    except (SyntaxError, ValueError) as error:
        raise Unreadable(_remedy(text, functions) or getattr(error, "msg", None) or str(error)) from None
    except (RecursionError, MemoryError):
        raise Unreadable("it is nested too deeply") from None


def chain(node: ast.AST, operators: tuple[type, type]) -> list[tuple[ast.AST, bool]]:
    """The members of a + b − c … or a * b / c …, and whether each is the second kind; without recursion."""
    members = []
    while isinstance(node, ast.BinOp) and isinstance(node.op, operators):
        members.append((node.right, isinstance(node.op, operators[1])))
        node = node.left
    return [(node, False), *reversed(members)]


def _check_characters(text: str) -> None:
    """Before Python's parser sees the text, which warns of calls of numbers and gives up on deep nesting."""
    if "#" in text:
        raise Unreadable("it holds a #, which would hide all that follows: leave comments out")
    depth = 0
    for character in text:
        depth += (character in "([{") - (character in ")]}")
        if depth > MAX_NESTING:
            raise Unreadable(f"it is nested more than {MAX_NESTING} deep")


def _remedy(text: str, functions: Container[str]) -> str | None:
    """The text to write in place of one that is not Python."""
    if found := re.search(r"(?<![\w.])(\d+\.?\d*)([A-Za-z(]\w*)", text):
        return f"{found[0]} lacks a sign: write {found[1]}*{found[2]}"
    if found := re.search(r"[²³⁴½¼√·×÷−π]", text):
        return f"{found[0]} is not understood: write q**2, sqrt(q), *, /, - and pi"
    if found := re.match(r"\s*[A-Za-z]\w*\s*(\([^)]*\)\s*)?=(?!=)", text):
        return f"leave {found[0].strip()!r} out: only what stands after it is H"
    if "|" in text:
        return "| is not understood: write abs(q)"
    if words := [word for word in re.findall(r"[A-Za-z_]\w*", text) if keyword.iskeyword(word)]:
        return f"{words[0]} is a word of Python: choose another name, such as {words[0]}_"
    if found := re.search(r"\b([A-Za-z]\w*) +([A-Za-z]\w*)", text):
        lacks, written = "a sign", f"{found[1]}*{found[2]}"
        if found[1] in functions:
            lacks, written = "brackets", f"{found[1]}({found[2]})"
        return f"{found[0]} lacks {lacks}: write {written}"
    return None


_TOKEN = re.compile(r"\s*(\.?\d[\w.]*(?:(?<=[eE])[+-]\d+)?|[^\W\d]\w*|\*\*|//|<<|>>|[<>=!]=|.)")


def _grouped(text: str) -> str:
    """The text, its long sums in brackets of `TERMS_IN_A_ROW` each, for a sum is nested as deep as it has terms."""
    if text.count("+") + text.count("-") <= TERMS_IN_A_ROW:
        return text
    written: list[str] = []
    counts, opened, last = [0], [False], "("
    for token in _TOKEN.findall(text):
        ends_sum = token in (*")]},<>", "<=", ">=", "==", "!=")
        if ends_sum and opened[-1]:
            written.append(")")
            opened[-1] = False
        if ends_sum:
            counts[-1] = 0
        if token in "([{":
            counts.append(0)
            opened.append(False)
        elif token in ")]}" and len(counts) > 1:
            counts.pop()
            opened.pop()
        elif token in "+-" and (last in ")]}" or last[-1].isalnum() or last[-1] in "_."):
            counts[-1] += 1
            if counts[-1] % TERMS_IN_A_ROW == 0:
                written.append(")+(" if opened[-1] else "+(")
                opened[-1] = True
        written.append(token)
        last = token
    return " ".join(written) + ")" * opened[0]
