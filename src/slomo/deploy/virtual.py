"""A twin without sockets in virtual time: link and clock of a dry run, and of tests that damage the datagrams."""

import heapq
import itertools
from collections.abc import Callable

from slomo.deploy.twin import Twin

# From a datagram and when it was sent to what comes out at the other end: (bytes, time, whether from the true address).
Channel = Callable[[bytes, float], list[tuple[bytes, float, bool]]]
STEP = 1e-3  # s
DELAY = 1e-4  # s, of a local network


def perfect(data: bytes, t: float) -> list[tuple[bytes, float, bool]]:
    """Everything arrives, once and soon."""
    return [(data, t + DELAY, True)]


class VirtualLink:
    """`Link` and `Clock` at once: while the run sleeps the twin lives on.

    Args:
        to_robot, to_client: what happens to the datagrams of either direction.
    """

    client, stranger = ("client", 1), ("stranger", 1)

    def __init__(self, twin: Twin, *, to_robot: Channel = perfect, to_client: Channel = perfect):
        self.twin, self.to_robot, self.to_client = twin, to_robot, to_client
        self.counts = {"foreign": 0}
        self._now = 0.0
        self._order = itertools.count()
        self._way: list[tuple[float, int, bool, bytes, bool]] = []
        self._inbox: list[tuple[bytes, float]] = []
        twin.begin(0.0)

    def now(self) -> float:
        return self._now

    def sleep_until(self, t: float) -> None:
        while self._now < t - 1e-9:
            self._now = min(self._now + STEP, t)
            self._deliver()
            for data in self.twin.advance(self._now):
                for out, arrival, true in self.to_client(data, self._now):
                    self._put(arrival, False, out, true)
            self._deliver()

    def send(self, data: bytes) -> None:
        for out, arrival, true in self.to_robot(data, self._now):
            self._put(arrival, True, out, true)

    def receive(self) -> list[tuple[bytes, float]]:
        inbox, self._inbox = self._inbox, []
        return inbox

    def close(self) -> None: ...

    def _put(self, arrival: float, to_robot: bool, data: bytes, true: bool) -> None:
        heapq.heappush(self._way, (arrival, next(self._order), to_robot, data, true))

    def _deliver(self) -> None:
        while self._way and self._way[0][0] <= self._now:
            arrival, _, to_robot, data, true = heapq.heappop(self._way)
            if to_robot:
                self.twin.receive(data, self.client if true else self.stranger, arrival)
            elif true:
                self._inbox.append((data, arrival))
            else:
                self.counts["foreign"] += 1
