"""The pages: what they name exists, and their links lead somewhere."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMED = re.compile(
    r"`((?:coordinator|services|sim|tests|tools)/[\w./-]+?)(?:::([\w.]+))?(?:\(\))?`"
)
LINK = re.compile(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)")
LONGEST_PAGE = 300
LONGER = {"protocol.md": 350}
"""A reference for those who write the other end: it is searched, not read."""


@cache
def names_in(path: Path) -> frozenset[str]:
    """Functions, classes, methods and constants of a module, `Class.method` for methods."""
    found: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            methods = (ast.FunctionDef, ast.AsyncFunctionDef)
            found |= {f"{node.name}.{n.name}" for n in node.body if isinstance(n, methods)}
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return frozenset(found)


def test_what_a_page_names_is_there() -> None:
    """Files as `folder/file.py`, functions as `folder/file.py::Class.function`."""
    wrong = []
    for page in PAGES:
        for path, name in NAMED.findall(page.read_text(encoding="utf-8")):
            there = ROOT / path
            if not there.exists() or (name and name not in names_in(there)):
                wrong.append(f"{page.relative_to(ROOT)}: {path}{'::' + name if name else ''}")
    assert not wrong, "\n".join(wrong)


def test_the_life_of_a_run_names_its_hops() -> None:
    """The page would say nothing if it named no function."""
    text = (ROOT / "docs" / "life-of-a-run.md").read_text(encoding="utf-8")
    hops = [name for _, name in NAMED.findall(text) if name]
    assert len(hops) >= 30


def test_links_lead_to_files() -> None:
    """Links between pages, and pictures."""
    wrong = [
        f"{page.relative_to(ROOT)}: {target}"
        for page in PAGES
        for target in LINK.findall(page.read_text(encoding="utf-8"))
        if not (page.parent / target).exists()
    ]
    assert not wrong, "\n".join(wrong)


def test_no_page_is_too_long() -> None:
    """A page that is longer should be two."""
    lengths = {page.name: len(page.read_text(encoding="utf-8").splitlines()) for page in PAGES}
    long = {name: n for name, n in lengths.items() if n > LONGER.get(name, LONGEST_PAGE)}
    assert long == {}
