"""From datagrams to states: whole ones, in order, each once, with the time at which they were measured."""

from collections import Counter
from dataclasses import replace

from slomo.deploy.go1 import TICK_HZ, TICKS, Go1, RobotState
from slomo.deploy.wire import Rejected

FORGET = 1e-3  # s a second, by which the least delay seen so far is forgotten: clocks drift apart by less


class Receiver:
    """Takes what the link brings.

    The robot's clock is set by the packet that came through fastest, so that a packet that was delayed counts as
    old. A delay that all packets share from the first one on cannot be seen.

    Attributes:
        counts: "accepted", "old" (out of order or a second time), and the reasons of `wire.Rejected`.
    """

    def __init__(self, go1: Go1):
        self.counts: Counter[str] = Counter()
        self._go1 = go1
        self._last: tuple[int, float] | None = None  # tick and arrival
        self._ran = 0.0  # s, on the robot's clock since the first state
        self._offset = 0.0

    def take(self, data: bytes, arrival: float) -> RobotState | None:
        """The state, if it is whole and newer than the last. Never raises, whatever the bytes. Args: arrival: s."""
        try:
            state = self._go1.state(data, arrival)
        except Rejected as reason:
            self.counts[str(reason)] += 1
            return None
        if self._last is None:
            self._offset = arrival
        else:
            tick, before = self._last
            ahead = (state.tick - tick) % TICKS
            if not 0 < ahead < TICKS // 2:
                self.counts["old"] += 1
                return None
            self._ran += ahead / TICK_HZ
            self._offset = min(arrival - self._ran, self._offset + FORGET * (arrival - before))
        self._last = state.tick, arrival
        self.counts["accepted"] += 1
        return replace(state, sample=replace(state.sample, t=self._ran + self._offset))
