"""Driver of the camera that looks at the floor ahead."""

from __future__ import annotations

from petrobot.services.camera import CameraDriver
from petrobot.services.device import key
from petrobot.services.mobile.model import nominal_rover, read_rover
from petrobot.services.mobile.watching import FloorWatch


class FloorCamera(CameraDriver):
    """A camera that knows how it is mounted on the rover."""

    rover: str = key("", "file of numbers beside services.toml; the shipped one if empty")

    def setup(self) -> None:
        name = self.rover
        rover = read_rover(self.ports.file(name).decode(), name) if name else nominal_rover()
        self.floor = FloorWatch.of(rover)
        self.usual_rate = rover.camera.rate
        self.shape = (self.floor.view.height, self.floor.view.width)
        self.shaped_by = "[camera] of the rover's file"
