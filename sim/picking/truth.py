"""The true pick-and-place cell: the nominal numbers, one installation's random errors, the parts of
a seed, and a regime's disturbances.

Only the laboratory reads this. A regime name is `plain` or `many` and any number of disturbances of
`sim/picking/laboratory.toml`, joined by `+` (or a comma): `plain+dim+oily`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec import Struct

from petrobot.services.comm.location_file import Directory
from petrobot.sim.catching.truth import LaboratoryError, disturbed, read_toml
from petrobot.sim.picking.camera import Lighting, Mounted, mounted
from petrobot.sim.picking.gripper import Fingers, TrueArm, true_arm
from petrobot.sim.picking.parts import Part, contact
from petrobot.sim.picking.world import TableTop

LABORATORY_FILE = Path(__file__).with_name("laboratory.toml")
_DRAWS: Final = 1500
"""Most random positions that are tried for the parts of an experiment."""


class PickingTruth(Struct, frozen=True):
    """The values of one regime, as `[nominal]` of the laboratory file names them."""

    parts: int
    values: Mapping[str, float]

    @property
    def force(self) -> float:
        """Return the force of the fingers, relative to the nominal one."""
        return self.values["force"]

    def light(self, direction: float) -> Lighting:
        """Return the light, with shadows towards `direction` (rad)."""
        band = self.values["band"]
        return Lighting(
            self.values["light"],
            direction,
            self.values["shadow_length"],
            self.values["darkness"],
            (0.06 * math.sin(direction), band) if band > 0.0 else None,
            self.values["noise"],
        )


class PickingSite(Struct, frozen=True):
    """The files of the cell: what its services know (`cell`, `numbers` of the arm), and the
    truth."""

    cell: Mapping[str, Any]
    numbers: Mapping[str, Any]
    settings: Mapping[str, Any]

    @property
    def readout(self) -> float:
        """Return the time from the middle of the exposure until the image leaves the camera (s)."""
        return 0.02

    @property
    def trays(self) -> Mapping[str, Any]:
        """The trays by name."""
        return self.cell["trays"]  # type: ignore[no-any-return]

    @property
    def belongs(self) -> Mapping[str, str]:
        """By kind of part: the tray where it belongs."""
        return {name: kind["tray"] for name, kind in self.cell["kinds"].items()}

    @property
    def table(self) -> TableTop:
        """The table's edges."""
        (x0, x1), (y0, y1) = self.cell["table"]["x"], self.cell["table"]["y"]
        return TableTop((x0, x1), (y0, y1))

    @property
    def fingers(self) -> Fingers:
        """The gripper's fingers."""
        gripper = self.numbers["gripper"]
        return Fingers(*(float(gripper[key]) for key in ("opening", "thickness", "width")))

    def _draws(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng((self.settings["installation"]["seed"], purpose))

    def arm(self) -> TrueArm:
        """Return the arm of this installation. Raises KeyError."""
        return true_arm(self.numbers, self.settings["installation"], self._draws(1))

    def camera(self) -> Mounted:
        """Return the camera of this installation. Raises KeyError."""
        return mounted(self.cell["camera"], self.settings["installation"], self._draws(2))

    def truth(self, regime: str) -> PickingTruth:
        """Return the truth of a regime. Raises LaboratoryError for an unknown one."""
        base, values = disturbed(self.settings, regime)
        return PickingTruth(int(base["parts"]), values)

    def parts(
        self, truth: PickingTruth, rng: np.random.Generator, count: int | None = None
    ) -> list[Part]:
        """Return the parts of an experiment at their positions. Raises LaboratoryError if so many
        do not fit on the table."""
        wanted = truth.parts if count is None else count
        area, placed = self.cell["parts"], list[Part]()
        for _ in range(_DRAWS):
            if len(placed) == wanted:
                return placed
            part = self._part(len(placed), truth, rng)
            part.x, part.y = float(rng.uniform(*area["x"])), float(rng.uniform(*area["y"]))
            part.turn = float(rng.uniform(-math.pi, math.pi))
            grown = _grown(part, truth.values["clearance"])
            if all(contact(grown.outline(), other.outline()) is None for other in placed):
                placed.append(part)
        raise LaboratoryError(
            f"parts: {wanted} do not fit on the table with a clearance of "
            f"{truth.values['clearance']} m; ask for fewer than {wanted}"
        )

    def _part(self, number: int, truth: PickingTruth, rng: np.random.Generator) -> Part:
        kinds, materials = self.cell["kinds"], self.settings["materials"]
        name = list(kinds)[int(rng.integers(len(kinds)))]
        kind = kinds[name]
        oily = bool(rng.random() < truth.values["oily"])
        others = [m for k, m in enumerate(materials) if k != 1]
        material = materials[1] if oily else others[int(rng.integers(len(others)))]
        scale = 1.0 + rng.normal(0.0, self.settings["parts"]["tolerance"], 3)
        length, width = (float(s) for s in kind["size"] * scale[:2])
        is_round = kind["shape"] == "round"
        if is_round:
            width = length
        height = float(kind["height"] * scale[2])
        area = math.pi / 4 * length**2 if is_round else length * width
        return Part(
            number,
            name,
            is_round,
            length,
            width,
            height,
            area * height * material["density"],
            float(rng.uniform(*material["friction"])),
            float(rng.uniform(*material["grey"])),
        )


def _grown(part: Part, by: float) -> Part:
    return Part(
        part.number, part.kind, part.round, part.length + 2 * by, part.width + 2 * by, part.height,
        part.mass, part.friction, part.grey, part.x, part.y, part.turn,
    )  # fmt: skip


def picking_site_of(directory: Directory) -> PickingSite:
    """Return the site of a location file: `[parameters] cell` and `arm`, and `laboratory` if it is
    not the shipped one. Raises LaboratoryError."""
    named = directory.parameters
    for key, example in (("cell", "cell.toml"), ("arm", "so101.toml")):
        if key not in named:
            raise LaboratoryError(
                f'{directory.source}: [parameters] {key} is missing; write {key} = "{example}"'
            )
    laboratory = named.get("laboratory")
    return PickingSite(
        read_toml(directory.file(named["cell"])),
        read_toml(directory.file(named["arm"])),
        read_toml(directory.file(laboratory) if laboratory else LABORATORY_FILE),
    )
