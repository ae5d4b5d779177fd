"""The process of the tuning page."""

from multiprocessing.connection import Connection
from typing import Any

from taichi_mrf.viewer.transport.process import run_viewer
from taichi_mrf.viewer.tune.page import TunePage


def run_tune_viewer(connection: "Connection[Any, Any]", host: str, port: int) -> None:
    """Serve the tuning page; see process.run_viewer."""
    run_viewer(connection, host, port, TunePage)
