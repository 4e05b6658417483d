"""The operator's page: draw a task, follow its tokens, step in; one server in the coordinator's own loop."""

from coordinator.hmi.port import HistoryPort, MissionPort, OffersPort
from coordinator.hmi.server import Page, start_page

__all__ = ["HistoryPort", "MissionPort", "OffersPort", "Page", "start_page"]
