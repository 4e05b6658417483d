"""Every vendored file is the one in the list, and nothing is fetched from another host."""

from __future__ import annotations

import hashlib
import re
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.once

PAGE = Path(__file__).parents[2] / "coordinator" / "page" / "static"
VENDOR = PAGE / "vendor"
LIST = tomllib.loads((VENDOR / "vendored.toml").read_text(encoding="utf-8"))
OWN = sorted(
    p for p in PAGE.rglob("*") if p.suffix in (".js", ".css", ".html") and VENDOR not in p.parents
)


def test_each_vendored_file_has_its_recorded_hash() -> None:
    """All vendored files are listed with their hashes, none is missing or additional, and each
    library names its version and licence."""
    listed: dict[str, str] = {}
    for name, library in LIST.items():
        assert library["version"] and library["licence"] and library["package"]
        listed |= {f"{name}/{file}": digest for file, digest in library["sha256"].items()}
    found = {
        str(p.relative_to(VENDOR)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in VENDOR.rglob("*")
        if p.is_file() and p.name != "vendored.toml"
    }
    assert found == listed


@pytest.mark.parametrize("path", OWN, ids=lambda p: p.name)
def test_nothing_is_loaded_from_another_host(path: Path) -> None:
    """There is no address of another host, no markup built from text, no inline handler or style.
    Files name each other relatively: so all that a page loads has one version."""
    text = path.read_text(encoding="utf-8")
    assert path.suffix == ".html" or "/page/" not in text
    addresses = [
        a
        for a in re.findall(r"https?://[^\s\"'`)]+", text)
        if "www.w3.org" not in a and "${" not in a
    ]
    assert addresses == []
    for forbidden in (
        "innerHTML",
        "outerHTML",
        "insertAdjacentHTML",
        "document.write",
        "eval(",
        "new Function",
    ):
        assert forbidden not in text
    if path.suffix == ".html":
        assert not re.search(
            r"<(?:script|style)(?![^>]*(?:src|href))[^>]*>|\son\w+=|\sstyle=", text
        )


@pytest.mark.parametrize("path", [p for p in OWN if p.suffix == ".js"], ids=lambda p: p.name)
def test_modules_state_their_purpose_and_stay_short(path: Path) -> None:
    """Each module begins with its purpose, and none exceeds a readable length."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("// ")
    assert len(lines) <= 520
