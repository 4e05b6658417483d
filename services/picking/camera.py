"""Driver of the camera above the table."""

from __future__ import annotations

from petrobot.services.camera import CameraDriver
from petrobot.services.device import key
from petrobot.services.picking.model import PickingCell, cell_named, read_cell


class TableCamera(CameraDriver):
    """A camera that knows the cell below it."""

    cell: str = key("", "file of numbers beside services.toml; the shipped one if empty")

    def setup(self) -> None:
        name = self.cell
        self.known: PickingCell = (
            read_cell(self.ports.file(name).decode(), name) if name else cell_named()
        )
        self.usual_rate = self.known.eye.rate
        self.shape = (self.known.eye.height, self.known.eye.width)
        self.shaped_by = "[camera] of the cell's file"
