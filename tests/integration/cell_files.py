"""Location files of the catching cell for tests: on free ports, or with devices and actions on
other nodes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from tests.ports import free_ports

ROOT = Path(__file__).parents[2]
SHIPPED = (ROOT / "services.toml").read_text(encoding="utf-8")


def services_file(folder: Path, *, edits: Mapping[str, str] | None = None, more: str = "") -> Path:
    """Write the shipped services.toml with free ports, with exact lines replaced and others added
    at its end."""
    text = SHIPPED.replace('"services/cell.toml"', f'"{ROOT / "services/cell.toml"}"')
    for old, new in (edits or {}).items():
        assert old in text, f"services.toml has no line {old!r} any more"
        text = text.replace(old, new)
    text += more
    named = sorted({int(port) for port in re.findall(r"\b(73\d\d)\b", text)} | {7299})
    table = dict(zip(named, free_ports(len(named)), strict=True))
    text = re.sub(r"\b(73\d\d|7299)\b", lambda found: str(table[int(found.group())]), text)
    if "[coordinator]" not in re.sub(r"#.*", "", text):
        text += f'\n[coordinator]\nhost = "127.0.0.1"\nport = {table[7299]}\n'
    path = folder / "services.toml"
    path.write_text(text, encoding="utf-8")
    return path
