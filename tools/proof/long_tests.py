"""The tests that take too long for `make test`."""

from __future__ import annotations

from tools.proof.proof import FigureProof, Result, command

SOURCES = ("coordinator", "services", "sim", "services.toml", "tests")


def marked_proof() -> Result:
    """Run all of them, two at a time."""
    done = command("pytest", "-m", "proof", "-n", "2", "-q")
    lines = done.stdout.strip().splitlines()
    return {"exit": done.returncode, "said": lines[-1].strip("= ") if lines else ""}


def proofs() -> list[FigureProof]:
    """Return one proof for all long tests."""
    return [
        FigureProof(
            "long tests",
            "Tests",
            marked_proof,
            lambda r: r["exit"] == 0,
            "all pass",
            SOURCES,
        )
    ]
