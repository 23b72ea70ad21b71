"""Datagrams to and from the robot, and the clock by which they go."""

import ipaddress
import socket
import time
from collections import Counter
from typing import Protocol

from slomo.errors import SlomoError, UsageError

ROBOT_PORT, LOCAL_PORT = 8007, 8080  # low level, of the robot and of its client
LOOPBACK = "127.0.0.1"
LONGEST = 2048  # bytes, read of a datagram
AT_ONCE = 1000  # datagrams, so that a flood does not hold up the loop
BUFFER = 1 << 20  # bytes, of the socket: states that come in while the process is held up are not lost


class Link(Protocol):
    """What brings datagrams to the robot and back."""

    def send(self, data: bytes) -> None: ...

    def receive(self) -> list[tuple[bytes, float]]:
        """What has come in from the robot since the last call, and when (s). Does not wait."""
        ...

    def close(self) -> None: ...


class Clock(Protocol):
    """The time (s) that the run goes by."""

    def now(self) -> float: ...

    def sleep_until(self, t: float) -> None: ...


class WallClock:
    """The system's monotonic clock."""

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        time.sleep(max(0.0, t - time.monotonic()))


def resolve(host: str) -> str:
    """The IPv4 address (text) of a host. Raises `UsageError` where there is none, or it is one of many robots."""
    try:
        address = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0]
    except OSError as e:
        raise UsageError(f"{host!r} is no address ({e.strerror})", where="--robot-address") from None
    where = ipaddress.ip_address(address)
    if where.is_multicast or where.is_unspecified or str(address) == "255.255.255.255":
        raise UsageError(f"{address} is not the address of one robot", where="--robot-address")
    return str(address)


def is_loopback(address: str) -> bool:
    """Whether what is sent to this IPv4 address stays in this computer."""
    return ipaddress.ip_address(address).is_loopback


class UdpLink:
    """A UDP socket that talks to one robot and hears no one else.

    Args:
        robot: its IPv4 address and port.
        local: port to send from; 0 for any.
        confirmed: the user has confirmed this very address. Needed for any address but loopback.

    Attributes:
        counts: "foreign": datagrams from another address or port; "unsent": the system would not take them.

    Raises:
        UsageError: an address that was not confirmed, or a port that is in use.
    """

    def __init__(self, robot: tuple[str, int], *, local: int = LOCAL_PORT, confirmed: str | None = None):
        if not is_loopback(robot[0]) and confirmed != robot[0]:
            raise UsageError(
                f"{robot[0]} is not in this computer and was not confirmed", where="--robot-address", todo="see --yes"
            )
        self.robot, self.counts = robot, Counter[str]()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        self._socket.setblocking(False)
        try:
            self._socket.bind((LOOPBACK if is_loopback(robot[0]) else "", local))
        except OSError as e:
            self._socket.close()
            raise SlomoError(f"cannot listen on UDP port {local} ({e.strerror})", where="--local-port") from None

    def send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self.robot)
        except OSError:  # unreachable, buffer full: the robot's silence and its watchdog deal with it
            self.counts["unsent"] += 1

    def receive(self) -> list[tuple[bytes, float]]:
        got = []
        for _ in range(AT_ONCE):
            try:
                data, source = self._socket.recvfrom(LONGEST)
            except BlockingIOError:
                break
            except ConnectionError:  # nobody listens at the robot's port
                continue
            if source == self.robot:
                got.append((data, time.monotonic()))
            else:
                self.counts["foreign"] += 1
        return got

    def close(self) -> None:
        self._socket.close()


class Muted:
    """A link that sends nothing: for --dry-run on a robot."""

    def __init__(self, link: Link):
        self._link = link

    def send(self, data: bytes) -> None: ...

    def receive(self) -> list[tuple[bytes, float]]:
        return self._link.receive()

    def close(self) -> None:
        self._link.close()
