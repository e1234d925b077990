"""HOST:PORT as people write it."""

from __future__ import annotations

from go1exp.deploy.runtime.go1_wire import ROBOT, ROBOT_PORT
from go1exp.deploy.runtime.launch import RobotError


def parsed_address(text: str | None, usual: tuple[str, int] = (ROBOT, ROBOT_PORT)) -> tuple[str, int]:
    """Return host and port of HOST:PORT; ``usual`` if None.

    Raises:
        RobotError: if it is written otherwise.
    """
    if text is None:
        return usual
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isascii() and port.isdigit() and int(port) < 2**16):
        raise RobotError(f"address={text}: must be HOST:PORT, such as {usual[0]}:{usual[1]}")
    return host, int(port)
