"""Net files by their endings: read, write, and list what the written format cannot keep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from petrobot.coordinator.analysis.formats import exports, pnml, tina
from petrobot.coordinator.analysis.formats.greatspn import parse_pnpro
from petrobot.coordinator.analysis.formats.netfile import NetFile, NetFileError
from petrobot.coordinator.analysis.formats.pnml import parse_pnml
from petrobot.coordinator.analysis.time.gspn import Chain

READ: dict[str, Callable[[bytes, str], NetFile]] = {
    ".pnml": parse_pnml,
    ".xml": parse_pnml,
    ".pnpro": parse_pnpro,
    ".net": lambda text, file: tina.parse_tina(_utf8(text, file), file),
}
"""Readers by ending. `.xml` is PNML as PIPE writes it. Bytes, because XML declares its encoding."""
WRITE = (".pnml", ".net", ".dot", ".drn")
"""Endings that can be written."""


def read_net(path: Path) -> NetFile:
    """Read the net in a file. Raises NetFileError, also for a file that cannot be opened."""
    reader = READ.get(path.suffix.lower())
    if reader is None:
        raise NetFileError(
            str(path), "file", f"{path.suffix or 'no'} ending", f"expected one of {', '.join(READ)}"
        )
    try:
        text = path.read_bytes()
    except OSError as error:
        raise NetFileError(
            str(path), "file", error.strerror or str(error), "give a readable file"
        ) from error
    return reader(text, str(path))


def _utf8(text: bytes, file: str) -> str:
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise NetFileError(file, "file", str(error), "give a UTF-8 file") from error


def written(model: NetFile, target: Path) -> tuple[str, list[str]]:
    """Return (the net as text, what is lost) in the format of the target's ending.

    Raises NetFileError.
    """
    match target.suffix.lower():
        case ".pnml":
            return pnml.write_pnml(model), pnml.losses(model)
        case ".net":
            return tina.write_tina(model), tina.losses(model)
        case ".dot":
            return exports.write_dot(model), ["a drawing: priorities, capacities and rates"]
        case ".drn":
            if model.gspn is None:
                raise NetFileError(
                    str(target), "rates", "the net has none", "give rates; a CTMC needs them"
                )
            return exports.write_drn(Chain.of(model.gspn)), [
                "the net itself: only its chain is written"
            ]
    ending = f"the ending {target.suffix}" if target.suffix else "a file without ending"
    raise NetFileError(
        str(target), "file", f"no writer for {ending}", f"end its name in {', '.join(WRITE)}"
    )
