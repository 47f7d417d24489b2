"""What the documentation shows is run: every Python block of README and docs, page by page, in order."""

import importlib.util
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from sympflow import shipped_flows
from sympflow.integrators import registry

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(?:<!-- needs: (?P<needs>\w+) -->\n)?^```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page):
    return list(BLOCK.finditer(page.read_text(encoding="utf-8")))


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=lambda page: page.stem)
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


def test_the_table_of_flows_is_that_of_the_package():
    assert shipped_flows().table() in (ROOT / "docs" / "training.md").read_text(encoding="utf-8")


def test_relative_links_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?://|#)([^)#\s]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        assert page.relative_to(ROOT / "docs").as_posix() in navigation


def test_every_public_name_is_in_the_reference():
    import sympflow

    reference = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference").glob("*.md"))
    for name in sympflow.__all__:
        home = sympflow._HOME.get(name)
        assert home is None or any(f"::: sympflow.{home}{end}" in reference for end in (f".{name}", "\n")), name


def test_the_site_builds_without_warnings(tmp_path):
    pytest.importorskip("mkdocs", reason='the site needs pip install "sympflow[docs]"')
    pytest.importorskip("mkdocstrings", reason='the site needs pip install "sympflow[docs]"')
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    page = (tmp_path / "site" / "reference" / "solve" / "index.html").read_text(encoding="utf-8")
    assert "poincare_section" in page
