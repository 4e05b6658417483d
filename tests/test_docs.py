"""Files, functions and modules that pages and docstrings name exist, and links work."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

from msgspec.structs import replace
from tools.proof.__main__ import FIGURES, kept, proofs, stands
from tools.proof.page import figures
from tools.proof.proof import FigureProof

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
CODE = [ROOT / folder for folder in ("coordinator", "services", "sim", "tests", "tools")]
NAMED = re.compile(
    r"`((?:coordinator|services|sim|tests|tools)/[\w./-]+?)(?:::([\w.]+))?(?:\(\))?`"
)
IN_SHORT = re.compile(r"`((?:[\w-]+/)*[\w-]+\.(?:py|js))`")
DOTTED = re.compile(r"`((?:coordinator|services|sim|tests|tools)(?:\.[A-Za-z_]\w*)+)")
CLASS = re.compile(r"`([A-Z][a-z0-9]+(?:[A-Z][a-z0-9]*)+)(?:\([^`]*\))?`")
LINK = re.compile(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)")
LONGEST_PAGE = 300
LONGER = {"protocol.md": 350}
"""A reference for authors of another implementation: they search it and do not read it through."""


@cache
def names_in(path: Path) -> frozenset[str]:
    """Return functions, classes, methods (`Class.method`) and constants of a module."""
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


def test_files_and_functions_named_by_pages_exist() -> None:
    """Files as `folder/file.py`, functions as `folder/file.py::Class.function`."""
    wrong = []
    for page in PAGES:
        for path, name in NAMED.findall(page.read_text(encoding="utf-8")):
            there = ROOT / path
            if not there.exists() or (name and name not in names_in(there)):
                wrong.append(f"{page.relative_to(ROOT)}: {path}{'::' + name if name else ''}")
    assert not wrong, "\n".join(wrong)


def test_files_named_in_short_exist() -> None:
    """A page may leave out the first folders of a file: `net/qualitative.py`."""
    known = {"/" + path.relative_to(ROOT).as_posix() for path in _sources("*.py", "*.js")}
    for folder in ("examples", "experiments"):
        known |= {f"/{path.relative_to(ROOT)}" for path in (ROOT / folder).rglob("*.py")}
    wrong = [
        f"{page.relative_to(ROOT)}: {name}"
        for page in [*PAGES, ROOT / "CHANGELOG.md"]
        for name in IN_SHORT.findall(page.read_text(encoding="utf-8"))
        if not any(path.endswith(f"/{name}") for path in known)
    ]
    assert not wrong, "\n".join(wrong)


def test_classes_named_by_pages_exist() -> None:
    """A name in capitals and small letters: a class, or a word of an error message or a file."""
    source = "\n".join(path.read_text(encoding="utf-8") for path in _sources("*.py", "*.js"))
    known = set(re.findall(r"\w+", source))
    wrong = [
        f"{page.relative_to(ROOT)}: {name}"
        for page in PAGES
        for name in CLASS.findall(page.read_text(encoding="utf-8"))
        if name not in known
    ]
    assert not wrong, "\n".join(wrong)


def test_modules_named_by_docstrings_exist() -> None:
    """Modules as `folder.module`, and names in them as `folder.module.name`."""
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in _sources("*.py")
        for name in DOTTED.findall(path.read_text(encoding="utf-8"))
        if not _exists(name)
    ]
    assert not wrong, "\n".join(wrong)


def _sources(*patterns: str) -> list[Path]:
    return [path for folder in CODE for pattern in patterns for path in folder.rglob(pattern)]


@cache
def _exists(dotted: str) -> bool:
    """Return whether a dotted name is a module or package, or occurs in one."""
    parts = dotted.split(".")
    for used in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:used])
        module = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if path.is_dir() and used == len(parts):
            return True
        if module.is_file():
            return used == len(parts) or parts[used] in module.read_text(encoding="utf-8")
    return False


def test_the_life_of_a_run_names_its_functions() -> None:
    """The test above would check nothing if the page named no function."""
    text = (ROOT / "docs" / "life-of-a-run.md").read_text(encoding="utf-8")
    hops = [name for _, name in NAMED.findall(text) if name]
    assert len(hops) >= 30


def test_links_point_to_files() -> None:
    """This includes links between pages, and pictures."""
    wrong = [
        f"{page.relative_to(ROOT)}: {target}"
        for page in PAGES
        for target in LINK.findall(page.read_text(encoding="utf-8"))
        if not (page.parent / target).exists()
    ]
    assert not wrong, "\n".join(wrong)


def test_no_page_is_too_long() -> None:
    """A longer page should be divided."""
    lengths = {page.name: len(page.read_text(encoding="utf-8").splitlines()) for page in PAGES}
    long = {name: n for name, n in lengths.items() if n > LONGER.get(name, LONGEST_PAGE)}
    assert long == {}


def test_lines_of_prose_have_their_width() -> None:
    """Not in tables, pictures, links to other places, and what a program prints."""
    wide, in_block = [], False
    for page in [*PAGES, *sorted((ROOT / "docs").glob("*/*.md"))]:
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
            in_block ^= line.startswith("```")
            free = in_block or page.name == "figures-analysis.md" or "http" in line
            if len(line) > 100 and not free and not line.startswith(("|", "![")):
                wide.append(f"{page.name}:{number}")
    assert wide == []


def test_the_figures_are_those_that_were_measured() -> None:
    """docs/figures.md is made from figures.json. Whether the measured code is still the same is
    for `make proof` to say, so it is left out here."""
    shown, made = FIGURES.read_text("utf-8"), figures(proofs(), kept())
    dated = re.compile(r" \(older\)| = [0-9a-f]{8}(?= \|)")
    assert dated.sub("", shown).splitlines() == dated.sub("", made).splitlines()


def test_a_figure_stands_as_long_as_its_sample_is_the_same() -> None:
    proof = FigureProof("a", "b", dict, bool, "", ["tools/proof/proof.py"], sample=lambda: "x")
    now = proof.fingerprint()
    for data, good in (
        ({"sources": now}, True),
        ({"sources": "old", "sample": "x"}, True),
        ({"sources": "old", "sample": "y"}, False),
        ({"sources": "old"}, False),
        ({}, False),
    ):
        assert stands(proof, {"a": data}) is good
        assert proof.holds_for(data) is good, "it is noted, so that the page says so"
    assert not stands(replace(proof, sample=None), {"a": {"sources": "old", "sample": "x"}})
