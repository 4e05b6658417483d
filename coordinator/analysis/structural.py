"""What the arcs of a net alone say, as plain data: invariants, siphons and traps, conflicts,
conservativeness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from petrobot.coordinator.analysis.siphons import (
    PlaceSets,
    controlled_siphons,
    minimal_siphons,
    minimal_traps,
)
from petrobot.coordinator.analysis.structure import (
    Semiflows,
    conflict_sets,
    exclusive_places,
    is_strictly_conservative,
    lyapunov,
    place_semiflows,
    transition_semiflows,
)
from petrobot.coordinator.net import Net


@dataclass(frozen=True)
class Structure:
    """What the arcs alone say, computed when asked for."""

    net: Net

    @cached_property
    def place_flows(self) -> Semiflows:
        """P-semiflows."""
        return place_semiflows(self.net)

    @cached_property
    def transition_flows(self) -> Semiflows:
        """T-semiflows."""
        return transition_semiflows(self.net)

    @cached_property
    def siphons(self) -> PlaceSets:
        """Minimal siphons."""
        return minimal_siphons(self.net)

    @cached_property
    def traps(self) -> PlaceSets:
        """Minimal traps."""
        return minimal_traps(self.net)

    def to_json(self) -> dict[str, Any]:
        """Plain data, places and transitions by name."""
        places, transitions = self.net.places, self.net.transitions
        function = lyapunov(self.net)
        return {
            "p_invariants": [
                {places[p]: n for p, n in sorted(y.items())} for y in self.place_flows.vectors
            ],
            "t_invariants": [
                {transitions[t]: n for t, n in sorted(x.items())}
                for x in self.transition_flows.vectors
            ],
            "invariants_complete": self.place_flows.complete and self.transition_flows.complete,
            "siphons": [sorted(places[p] for p in s) for s in self.siphons.sets],
            "traps": [sorted(places[p] for p in s) for s in self.traps.sets],
            "siphons_complete": self.siphons.complete and self.traps.complete,
            "siphons_controlled": controlled_siphons(self.net, found=self.siphons),
            "structurally_bounded": function is not None,
            "conservative": function is not None and function.conserved,
            "strictly_conservative": is_strictly_conservative(self.net),
            "lyapunov": {places[p]: n for p, n in sorted(function.weights.items())}
            if function
            else None,
            "conflicts": [[transitions[t] for t in group] for group in conflict_sets(self.net)],
            "exclusive_places": sorted(
                [places[p], places[q]] for p, q in exclusive_places(self.net, self.place_flows)
            ),
        }
