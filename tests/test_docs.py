"""The code of the documentation is run: every Python block of README and docs, page by page, in order."""

import importlib.util
import json
import os
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import sympflow
from sympflow import shipped_flows
from sympflow.integrators import registry

ROOT = Path(__file__).parent.parent
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.parent.name != "measured"),
]
MEASURED = ROOT / "docs" / "measured"
BLOCK = re.compile(r"(?:<!-- needs: (?P<needs>\w+) -->\n)?^```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page):
    return list(BLOCK.finditer(page.read_text(encoding="utf-8")))


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page) and page.stem != "gallery"], ids=lambda page: page.stem
)
@pytest.mark.filterwarnings("default")
def test_the_code_on_a_page_runs(page, tmp_path, monkeypatch):
    """In a namespace of its own and an empty folder; the README in an interpreter of its own, as its reader has it."""
    parts = []
    for block in blocks(page):
        if block["needs"] and importlib.util.find_spec(block["needs"]) is None:
            continue
        parts.append(f"# {page.name}, line {page.read_text(encoding='utf-8')[: block.start()].count(chr(10)) + 1}")
        parts.append(block["code"])
    script = tmp_path / "page.py"
    script.write_text("\n".join(parts), encoding="utf-8")
    monkeypatch.setenv("MPLBACKEND", "agg")
    if page.stem == "README":
        command = [sys.executable, str(script)]
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        return
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    runpy.run_path(str(script), run_name="page")


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_printed_outputs_are_those_of_the_code(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    outputs = runpy.run_path(str(ROOT / "docs" / "outputs.py"))
    for name in outputs["PAGES"]:
        text = (ROOT / "docs" / name).read_text(encoding="utf-8")
        assert outputs["page_with_outputs"](text) == text
    notebook = json.loads(outputs["NOTEBOOK"].read_text(encoding="utf-8"))
    assert any(cell.get("outputs") for cell in notebook["cells"])
    assert outputs["notebook_with_outputs"](json.loads(json.dumps(notebook))) == notebook


@pytest.mark.slow
def test_the_code_of_the_gallery_draws(tmp_path, monkeypatch):
    """A hundredth of each run, by array operations; `python docs/gallery.py` runs them in full."""

    def briefly(function):
        def run(system, method, t_span, y0=None, **options):
            if "t_eval" in options:
                times = np.asarray(options["t_eval"]) / 100
                options["t_eval"] = times[:: 1 + len(times) // 20]
            if function is solve and method != "rk45":
                options["backend"] = "array"
            return function(system, method, (0, t_span[1] / 100), y0, **options)

        return run

    solve = sympflow.solve
    for name in ("solve", "poincare_section", "sali", "escape_times"):
        monkeypatch.setattr(sympflow, name, briefly(getattr(sympflow, name)))
    gallery = runpy.run_path(str(ROOT / "docs" / "gallery.py"))
    monkeypatch.setitem(gallery["draw"].__globals__, "PICTURES", tmp_path)
    gallery["draw"](set())
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"\(figures/gallery/(.+?)\)", page))
    assert shown == {path.name for path in tmp_path.iterdir()}
    assert shown == {path.name for path in (ROOT / "docs" / "figures" / "gallery").iterdir()}
    assert len(shown) == page.count("\n### ")


def test_the_table_of_flows_is_that_of_the_package():
    assert shipped_flows().table() in (MEASURED / "flows.md").read_text(encoding="utf-8")


def test_relative_links_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?://|#)([^)#\s]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_code_on_a_page_is_not_wider_than_it():
    for page in PAGES[1:]:
        for code in re.findall(r"^```\w*\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
            assert max(map(len, code.splitlines())) <= 88, f"{page.name}:\n{code}"


def test_formulas_are_tex_that_can_be_typeset():
    pytest.importorskip("math_core", reason='formulas need pip install ".[docs]"')
    mathml = runpy.run_path(str(ROOT / "docs" / "typeset.py"))["mathml"]
    assert "<mfrac>" in mathml(r"\frac{1}{2}")
    with pytest.raises(ValueError, match="frca"):
        mathml(r"\frca{1}{2}")
    for page in PAGES[1:]:
        text = re.sub(r"^```.*?^```$|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        for display, inline in re.findall(r"\$\$(.+?)\$\$|\$([^$]+)\$", text, re.DOTALL):
            assert mathml(display or inline).startswith("<math")


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in PAGES[1:]:
        assert page.relative_to(ROOT / "docs").as_posix() in navigation


def test_every_public_name_is_in_the_reference():
    reference = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference").glob("*.md"))
    for name in sympflow.__all__:
        home = sympflow._HOME.get(name)
        known = {f"::: sympflow.{path}\n" for path in (name, home, f"{home}.{name}")}
        assert home is None or any(words in reference for words in known), name


@pytest.mark.slow
def test_the_site_is_whole(tmp_path):
    """No warning, which a dead link or a page that no list leads to is, and no script from the network."""
    pytest.importorskip("mkdocs", reason='the site needs pip install ".[docs]"')
    pytest.importorskip("mkdocstrings", reason='the site needs pip install ".[docs]"')
    site = tmp_path / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(site)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "poincare_section" in (site / "reference" / "solve.html").read_text(encoding="utf-8")
    assert "__index = " in (site / "search" / "search_index.js").read_text(encoding="utf-8")
    for page in site.rglob("*.html"):
        scripts = re.findall(
            r'<(?:script|link)[^>]*(?:src|href)="(https?:[^"]+\.(?:js|css))"', page.read_text(encoding="utf-8")
        )
        assert not scripts, f"{page.name} loads {scripts}"


# figures ----------------------------------------------------------------------------------------------

QUOTES = re.compile(r"^(?!    ).*?<!-- quotes (?P<fragment>[\w-]+): (?P<figures>[^>]+?) -->", re.MULTILINE)
FIGURE = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[-+−]?\d+)?")


def quotes(page):
    """Each comment with the paragraph that it stands in, comments taken out: (fragment, figures, words)."""
    for paragraph in re.split(r"\n\s*\n", page.read_text(encoding="utf-8")):
        words = re.sub(r"<!--.*?-->", "", paragraph, flags=re.DOTALL)
        for comment in QUOTES.finditer(paragraph):
            yield comment["fragment"], [f.strip() for f in comment["figures"].split(", ")], words


def figures(text):
    """The numbers in a text as they are written."""
    return [f.rstrip(",") for f in FIGURE.findall(text)]


def stands_in(figure, others):
    """True if one of the numbers is the figure, or rounds to it at the digits that the figure has."""
    plain = figure.replace(",", "").replace("−", "-")
    mantissa, _, power = plain.partition("e")
    unit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    values = (float(other.replace(",", "").replace("−", "-")) for other in others)
    return any(abs(value - float(plain)) <= 0.5000001 * unit for value in values)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if QUOTES.search(page.read_text("utf-8"))], ids=lambda p: p.stem
)
def test_quoted_figures_stand_in_their_fragments(page):
    for fragment, quoted, words in quotes(page):
        table = (MEASURED / f"{fragment}.md").read_text(encoding="utf-8")
        for figure in quoted:
            assert figure in figures(words), f"{page.name} quotes {figure} of {fragment}, but does not say it"
            assert stands_in(figure, figures(table)), f"{page.name} quotes {figure}, which is not in {fragment}"


def test_the_diagrams_are_those_of_the_package():
    diagrams = runpy.run_path(str(ROOT / "docs" / "diagrams.py"))
    for name in ("rooms", "solve"):
        drawn = (ROOT / "docs" / "figures" / f"{name}.svg").read_text(encoding="utf-8")
        assert drawn == diagrams[name](), f"python docs/diagrams.py draws another {name}.svg"
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = [
        tuple(layer.split(" | "))
        for layer in contracts[0]["layers"]
        if layer not in ("__main__", "cli", "lazy", "_version")
    ]
    assert [row for row, _ in diagrams["ROOMS"]] == layers, (
        "docs/diagrams.py draws other layers than pyproject.toml has"
    )


def test_every_fragment_is_included_and_says_where_it_is_from():
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for fragment in MEASURED.glob("*.md"):
        assert f'--8<-- "measured/{fragment.name}"' in text, fragment.name
        source = fragment.read_text(encoding="utf-8").splitlines()[-1]
        assert re.fullmatch(r"<small>`[^`]+` · .+ · commit .+ · \d{4}-\d\d-\d\d</small>", source), fragment.name


def test_the_table_of_where_to_add_names_what_is_there():
    table = (ROOT / "docs" / "architecture.md").read_text().split("## Where do I add")[1].split("## ")[0]
    rows = [row.split("|") for row in table.splitlines() if row.startswith("| a ")]
    assert len(rows) > 8
    for _, _, file, there, *_ in rows:
        for path in re.findall(r"`([\w/]+\.py)`", file):
            code = (ROOT / "sympflow" / path).read_text()
            name = re.search(r"`([A-Za-z_]+)`(?!.*`[A-Z_]+`)", there)
            assert name is not None, there
            assert re.search(rf"^(class |def )?{name[1]}\b", code, re.M), f"{path} has no {name[1]}"


def test_every_image_says_what_it_shows():
    for page in PAGES:
        for words in re.findall(r"!\[([^\]]*)\]\(", page.read_text(encoding="utf-8")):
            assert len(words) > 10, f"{page.name} has an image without a description"


def test_a_figure_stands_where_it_is_or_is_rounded_from():
    assert stands_in("3.8", ["3.79", "12"])
    assert stands_in("1.0e-08", ["1.02e-8"])
    assert stands_in("8,000", ["8000"])
    assert not stands_in("3.7", ["3.79"])
    assert not stands_in("5.4e-7", ["5.5e-07"])
    assert figures("takes 1,243,312 steps, 2.3 to 4e-5 s") == ["1,243,312", "2.3", "4e-5"]
