"""Viewer processes for tests of the line to them: they show nothing."""

import os
import signal
import time
from multiprocessing.connection import Connection

from taichi_mrf.viewer.messages import Alive, Listening, Notice, Quit, Status, Step


def echo(connection: Connection, host: str, port: int) -> None:
    """Says where it is, and asks for a step for each update, until it is told to quit."""
    connection.send(Listening(host, port))
    while not isinstance(update := connection.recv(), Quit):
        if not isinstance(update, Alive):
            connection.send(Step())


def deaf(connection: Connection, host: str, port: int) -> None:
    """Reads nothing, and ignores that it should end."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    connection.send(Listening(host, port))
    while True:
        time.sleep(1)


def dead(connection: Connection, host: str, port: int) -> None:
    """Ends at the first update."""
    connection.send(Listening(host, port))
    connection.recv()
    os._exit(3)


def refusing(connection: Connection, host: str, port: int) -> None:
    """Has no page, and says why."""
    connection.send(Notice(f"{host} is not an address of this machine", "error"))


def patient(connection: Connection, host: str, port: int) -> None:
    """Begins to read once it is signalled, and says, in place of a port, how many updates came before the
    Status."""
    begin: list[int] = []
    signal.signal(signal.SIGUSR1, lambda number, frame: begin.append(number))
    connection.send(Listening(host, port))
    while not begin:
        time.sleep(0.01)
    count = 0
    while not isinstance(connection.recv(), Status):
        count += 1
    connection.send(Listening(host, count))
    connection.recv()
