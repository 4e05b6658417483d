"""A campaign's progress in a terminal: one line that is written over, and the time to go."""

from __future__ import annotations

from typing import TextIO

from petrobot.coordinator.studies.campaign.conduct import Progress

WIDTH = 30
BEFORE = 0.2
"""s between two updates at least."""


def clock(seconds: float) -> str:
    """Seconds as m:ss or h:mm:ss."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def line(progress: Progress) -> str:
    """The line: a bar, how many trials are done, how many met their goal in this session, time gone
    and to go."""
    full = round(WIDTH * progress.done / max(1, progress.of))
    fresh = progress.done - progress.already
    left = progress.seconds / fresh * (progress.of - progress.done) if fresh else 0.0
    met = f"{progress.goals / fresh:.1%} met" if fresh else ""
    bar = "#" * full + "." * (WIDTH - full)
    return (
        f"[{bar}] {progress.done}/{progress.of}  {met}  {clock(progress.seconds)} gone, "
        f"{clock(left)} to go"
    )


class ProgressLine:
    """Writes the line to a terminal; nothing where there is none."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._shown = -BEFORE
        self._length = 0
        self.wanted = out.isatty()

    def __call__(self, progress: Progress) -> None:
        """Show it, unless the last update was a moment ago and this is not the end."""
        if not self.wanted or (
            progress.seconds - self._shown < BEFORE and progress.done < progress.of
        ):
            return
        self._shown = progress.seconds
        text = line(progress)
        print("\r" + text.ljust(self._length), end="", file=self._out, flush=True)
        self._length = len(text)

    def close(self) -> None:
        """End the line."""
        if self._length:
            print(file=self._out, flush=True)
