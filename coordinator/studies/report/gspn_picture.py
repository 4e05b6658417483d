"""The stochastic view as SVG: timed transitions are boxes, immediate ones bars, each with its rate
or weight and where that comes from."""

from __future__ import annotations

import re
from collections.abc import Mapping

from petrobot.coordinator.analysis.formats.netfile import NetFile
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.drawing import Caption, Overlay, draw


def gspn_svg(model: NetFile, sources: Mapping[str, str], title: str, assumed: str) -> str:
    """Return the drawing of a net with rates. `sources`: where the number of a transition comes
    from; `assumed`: which cell, empty for a net of another tool."""
    # In a GSPN of a task a place and a transition may have the same name; a drawing needs two.
    renamed, _ = model.with_names(re.compile(".+", re.DOTALL))
    gspn = renamed.gspn
    assert gspn is not None
    pairs = zip(gspn.net.transitions, model.net.transitions, strict=True)
    captions = {
        name: _caption(gspn, t, old, sources.get(old, "")) for t, (name, old) in enumerate(pairs)
    }
    overlay = Overlay(legend=f"Assumed: {assumed}." if assumed else "")
    return draw(renamed.net, title=title, captions=captions, overlay=overlay)


def _caption(gspn: Gspn, t: int, name: str, source: str) -> Caption:
    """Return what the drawing says of a transition."""
    rate, servers = gspn.rate[t], gspn.servers[t]
    if rate is not None:
        said = f"{rate:.4g}/s"
        if servers != 1:
            said += " for each token" if servers is None else f", {servers} servers"
    else:
        said = f"weight {gspn.weight[t]:.4g}" if source or gspn.weight[t] != 1.0 else ""
    kind = "immediate" if rate is None else "timed"
    hint = "; ".join(text for text in (f"{kind} transition {name}", said, source) if text)
    return Caption(tuple(text for text in (name, said, source) if text), hint, kind)
