"""Real sockets, real processes, a log that outlives them."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from slomo.deploy.brain import Died, OwnProcess
from slomo.deploy.go1 import Go1
from slomo.deploy.link import UdpLink, is_loopback, resolve
from slomo.deploy.log import HEADER, RECORD, SENT, Log, read
from slomo.deploy.run import check_way
from slomo.deploy.stops import Stops
from slomo.deploy.supervisor import Cause
from slomo.deploy.twin import RELEASE, serve
from slomo.errors import InvalidData, SlomoError, UsageError
from slomo.track.sensors import SensorSample
from twin_bench import Standing, go1, new_twin


def until(true, seconds=20.0):
    """Wait for something. Fails if it does not come true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return
        time.sleep(0.02)
    pytest.fail("did not happen")


class Served:
    """A twin on a free port of this computer, in a thread."""

    def __enter__(self):
        self.twin, self.said, self._end = new_twin(), [], False
        self._thread = threading.Thread(
            target=serve, args=(self.twin, "127.0.0.1", 0), kwargs=dict(until=lambda: self._end, say=self.said.append)
        )
        self._thread.start()
        until(lambda: self.said)
        self.port = int(self.said[0].split(":")[-1])
        return self

    def __exit__(self, *error):
        self._end = True
        self._thread.join()


def test_twin_answers_its_client_and_obeys_no_other():
    with Served() as served, UdpClient(served.port) as client, UdpClient(served.port, "127.0.0.2") as stranger:
        client.send(Go1(go1()).damping_datagram())
        until(lambda: client.receive())
        before = served.twin.command
        for _ in range(20):
            stranger.send(Go1(go1()).off_datagram())
            client.send(Go1(go1()).damping_datagram())
        until(lambda: served.twin.counts["foreign"] == 20)
        assert before is not None
        assert served.twin.command is not None
        assert not stranger.receive()


class UdpClient:
    """A plain socket."""

    def __init__(self, port, host="127.0.0.1"):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))
        self._socket.setblocking(False)
        self._to = ("127.0.0.1", port)
        self.port = self._socket.getsockname()[1]

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._socket.close()

    def send(self, data, to=None):
        self._socket.sendto(data, to or self._to)

    def receive(self):
        try:
            return self._socket.recvfrom(2048)[0]
        except BlockingIOError:
            return None


def test_link_hears_the_robot_alone():
    with UdpClient(1) as robot, UdpClient(1, "127.0.0.2") as stranger, UdpClient(1) as same_host:
        link = UdpLink(("127.0.0.1", robot.port), local=0)
        here = link._socket.getsockname()
        link.send(b"hello")
        until(lambda: robot.receive() == b"hello")
        for sender in (stranger, same_host, robot):
            sender.send(b"state", here)
        got = []
        until(lambda: got.extend(link.receive()) or (got and link.counts["foreign"] == 2))
        assert [data for data, _ in got] == [b"state"]
        link.close()


def test_link_survives_a_robot_that_is_not_there():
    # Made before the other is gone: it could be given the port that becomes free, and hear itself.
    with UdpClient(1) as gone:
        link = UdpLink(("127.0.0.1", gone.port), local=0)
    for _ in range(5):
        link.send(b"x")
        time.sleep(0.002)
        assert link.receive() == []
    link.close()


def test_a_port_that_is_taken():
    with UdpClient(1) as other, pytest.raises(SlomoError, match="cannot listen"):
        UdpLink(("127.0.0.1", 1), local=other.port)


def test_no_socket_for_another_computer_without_its_confirmation(monkeypatch):
    monkeypatch.setattr(socket, "socket", lambda *a: pytest.fail("a socket was made"))
    for confirmed in (None, "192.0.2.2"):
        with pytest.raises(UsageError, match="not confirmed"):
            UdpLink(("192.0.2.1", 8007), confirmed=confirmed)


def test_the_way_is_asked_about_where_it_leads_out_of_this_computer():
    rest = dict(port=8007, local_port=8080)
    asked = []

    def no(address):
        asked.append(address)
        return False

    for host in (None, "127.0.0.1", "localhost"):
        assert check_way("go1-udp", host, confirm=no, **rest).confirmed is None
    assert not asked
    with pytest.raises(UsageError, match="nothing was sent"):
        check_way("go1-udp", "192.0.2.1", confirm=no, **rest)
    assert asked == ["192.0.2.1"]
    assert check_way("go1-udp", "192.0.2.1", confirm=lambda a: True, **rest).confirmed == "192.0.2.1"
    way = check_way("go1-udp", "192.0.2.1", confirm=no, dry=True, **rest)  # it only listens
    assert way.dry
    assert asked == ["192.0.2.1"]
    with pytest.raises(UsageError, match="in this computer"):
        check_way("twin", "192.0.2.1", confirm=no, dry=True, **rest)
    with pytest.raises(UsageError, match="in this computer"):
        check_way("twin", "192.0.2.1", confirm=lambda a: True, **rest)
    with pytest.raises(UsageError, match="valid: twin, go1-udp"):
        check_way("ros", None, confirm=no, **rest)
    for host in ("224.0.0.1", "255.255.255.255", "0.0.0.0"):
        with pytest.raises(UsageError, match="one robot"):
            resolve(host)
    assert is_loopback("127.8.9.1")
    assert not is_loopback("10.0.0.1")


def test_twin_gives_up_a_client_that_is_gone():
    twin = new_twin()
    twin.begin(0.0)
    damping = Go1(go1()).damping_datagram()
    twin.receive(damping, ("a", 1), 0.0)
    twin.receive(damping, ("b", 1), RELEASE - 0.01)
    assert twin.client == ("a", 1)
    twin.receive(damping, ("b", 1), RELEASE + 0.01)
    assert twin.client == ("b", 1)


def test_rubbish_does_not_keep_the_watchdog_quiet():
    twin = new_twin()
    twin.begin(0.0)
    twin.receive(Go1(go1()).damping_datagram(), ("a", 1), 0.0)
    for k in range(1, 80):
        twin.receive(os.urandom(614), ("a", 1), 0.002 * k)
        twin.advance(0.002 * k)
    assert twin.counts["watchdog"] == 1
    assert twin.command is None


SAMPLE = SensorSample(0.0, np.zeros(12), np.zeros(12), np.zeros(12), np.zeros(3), np.zeros(3))


def test_a_controller_in_its_own_process_answers_and_its_death_is_seen():
    brain = OwnProcess(Standing, realtime=False)
    brain.start(SAMPLE)
    brain.ask(0.25, [SAMPLE])
    reply = brain.answer(10.0)
    assert reply is not None
    assert reply.t == 0.25
    assert brain.answer(0.0) is None
    assert brain.pid is not None
    os.kill(brain.pid, signal.SIGKILL)

    def ask_on():
        for _ in range(1000):
            brain.ask(0.5, [SAMPLE])
            brain.answer(0.01)

    with pytest.raises(Died):
        ask_on()
    brain.close()


def broken():
    raise ValueError("no such motion")


def test_a_controller_that_cannot_start_says_why():
    with pytest.raises(SlomoError, match="no such motion"):
        OwnProcess(broken, realtime=False)


def slow():
    time.sleep(60)


def test_a_controller_that_is_still_compiling_can_be_given_up():
    def stop():
        raise SlomoError("stopped")

    with pytest.raises(SlomoError, match="stopped"):
        OwnProcess(slow, realtime=False, waiting=stop)
    assert not [child for child in multiprocessing.active_children() if child.name.startswith("SpawnProcess")]


def header_and(count, path, **more):
    log = Log(path, {"name": "x"}, **more)
    for k in range(count):
        log.record["t"] = 0.002 * k
        log.append()
    return log


def test_log_there_and_back(tmp_path):
    header_and(7, tmp_path / "a.log").close()
    header, records = read(tmp_path / "a.log")
    assert header["name"] == "x"
    assert records["number"].tolist() == list(range(1, 8))
    assert (tmp_path / "a.log").stat().st_size == HEADER + 7 * RECORD.itemsize


def test_log_is_a_ring(tmp_path):
    header_and(1250, tmp_path / "a.log", seconds=2).close()
    assert read(tmp_path / "a.log")[1]["number"].tolist() == list(range(251, 1251))


def test_torn_records_are_left_out(tmp_path):
    path = tmp_path / "a.log"
    log = header_and(9, path, seconds=1)
    log._map[HEADER + 4 * RECORD.itemsize + 100] ^= 1
    assert read(path)[1]["number"].tolist() == [1, 2, 3, 4, 6, 7, 8, 9]
    log.close()
    with open(path, "r+b") as f:
        f.truncate(HEADER + 2 * RECORD.itemsize + 50)
    assert read(path)[1]["number"].tolist() == [1, 2]


@pytest.mark.parametrize("content", [b"", b"{}", b"\x00" * 100_000, b'{"magic": "slomo deploy log 1"}'.ljust(HEADER)])
def test_what_is_no_log(tmp_path, content):
    (tmp_path / "a.log").write_bytes(content)
    with pytest.raises(InvalidData, match=r"a\.log"):
        read(tmp_path / "a.log")


def test_any_key_at_the_terminal_stops(monkeypatch):
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        with Stops() as stops:
            assert stops.terminal
            assert stops() is None
            os.write(ours, b" ")  # no need for Enter
            cause, detail = stops() or ("", "")
            assert cause == Cause.STOP_KEY
            assert "' '" in detail
    os.close(ours)


RUNS = """
    import dataclasses, sys
    from pathlib import Path
    from twin_bench import QUICK, Standing, go1
    from slomo.deploy.drive import Drive
    from slomo.deploy.go1 import Go1
    from slomo.deploy.link import UdpLink, WallClock
    from slomo.deploy.log import Log
    from slomo.deploy.stops import Stops

    link = UdpLink(("127.0.0.1", int(sys.argv[1])), local=0)
    log = Log(Path(sys.argv[2]), {}, seconds=60)
    with Stops() as stops:
        config = dataclasses.replace(QUICK, hold=60.0, fold=60.0, max_power=1e6)
        drive = Drive(go1(), link, WallClock(), Standing(), log, config=config, go1=Go1(go1()), stopped=stops)
        # How punctual this machine is, loaded as it may be, is not what is tested here.
        drive.supervisor.watch = drive.supervisor.ready = lambda now: None
        drive.run()
    log.close()
"""


def start_run(port, path):
    tests = str(Path(__file__).parent)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([tests, *sys.path])}
    program = [sys.executable, "-c", textwrap.dedent(RUNS), str(port), str(path)]
    return subprocess.Popen(program, env=environment, stdin=subprocess.DEVNULL)


def holding(path):
    """Whether the motors are being held by the run."""
    try:
        return SENT[read(path)[1]["sent"][-1]] == "servo"
    except InvalidData:
        return False


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_run_that_is_ended_by_a_signal(tmp_path, number):
    """After SIGKILL the twin's watchdog damps the motors, and the log is there; after SIGTERM the run itself does."""
    path = tmp_path / "run.log"
    with Served() as served:
        process = start_run(served.port, path)
        until(lambda: holding(path) and not served.twin.damped, 120)
        before = served.twin.counts["watchdog"]
        process.send_signal(number)
        process.wait(60)
        until(lambda: served.twin.damped)
        _, records = read(path)
        assert len(records) > 20
        if number == signal.SIGKILL:
            until(lambda: served.twin.counts["watchdog"] > before)
            assert served.twin.command is None
            assert not records["trip"].any()
        else:
            assert process.returncode == 0
            assert number.name in records["why"][-1].decode()
            assert SENT[records["sent"][-1]] == "off"
