"""A chain for Storm: the explicit DRN format of a CTMC over tangible markings, labelled by the
places that are marked.

Source: Storm's documentation of its explicit input, DRN (direct encoding).
"""

from __future__ import annotations

import numpy as np

from petrobot.coordinator.analysis.formats.netfile import FormatError
from petrobot.coordinator.analysis.time.gspn import Chain
from petrobot.coordinator.analysis.time.markov import Generator


def write_drn(chain: Chain) -> str:
    """The DRN text of a chain whose initial marking is tangible. Raises FormatError otherwise.

    Labels are `init`, `deadlock`, and the name of each marked place with everything but letters,
    digits and _ replaced.
    """
    if chain.vanishing[0]:
        remedy = "give the first transition a rate: a CTMC begins in one marking that lasts"
        raise FormatError("drn", "init", "the initial marking vanishes at once", remedy)
    made = Generator.of(chain)
    rates = (made.matrix.T * made.rate).tocsr()
    marked = np.stack(
        [chain.space.tokens(p)[made.tangible] > 0 for p in range(len(chain.space.net.places))]
    )
    names = [_identifier(name) for name in chain.space.net.places]
    lines = [
        "// A GSPN's chain over its tangible markings, rates in 1/s",
        "@type: CTMC",
        "@parameters",
        "",
        "@reward_models",
        "",
    ]
    lines += [
        "@nr_states",
        str(len(made.tangible)),
        "@nr_choices",
        str(len(made.tangible)),
        "@model",
    ]
    for i, n in enumerate(made.tangible.tolist()):
        first, last = rates.indptr[i], rates.indptr[i + 1]
        out = [
            (int(j), float(r))
            for j, r in zip(rates.indices[first:last], rates.data[first:last], strict=True)
            if j != i
        ]
        out = [(j, r) for j, r in sorted(out) if r > 0]
        total = sum(r for _, r in out)
        labels = [names[p] for p in np.flatnonzero(marked[:, i]).tolist()]
        labels = (["init"] if n == 0 else []) + (["deadlock"] if not out else []) + labels
        lines.append(f"state {i} !{total or 1.0!r} {' '.join(labels)}".rstrip())
        lines.append("\taction 0")
        lines += [f"\t\t{j} : {r!r}" for j, r in out or [(i, 1.0)]]
    return "\n".join(lines) + "\n"


def _identifier(name: str) -> str:
    clean = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
    return clean if clean[:1].isalpha() or clean[:1] == "_" else f"p_{clean}"
