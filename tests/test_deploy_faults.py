"""What can go wrong between controller and robot, in virtual time: what is ridden out, and how soon the rest ends in
damping and under which name."""

import random
from dataclasses import replace

import numpy as np
import pytest

from slomo.deploy.brain import Died
from slomo.deploy.log import SENT, read
from slomo.deploy.sequence import ORDER, Phase
from slomo.deploy.supervisor import CAUSES, Cause
from slomo.deploy.virtual import perfect
from twin_bench import FAULT, QUICK, Standing, late, lossy, run

TICK = 0.002


def phases(path):
    _, records = read(path)
    return [ORDER[k] for k in dict.fromkeys(records["phase"].tolist())]


def assert_played(link, drive, path):
    """It stood up, played, lay down, and that was all."""
    assert drive.supervisor.trip is None
    assert phases(path) == list(ORDER)
    _, records = read(path)
    playing = records[records["phase"] == ORDER.index(Phase.PLAY)]
    assert playing["truth"][:, 2].min() > 0.24  # it stood all the while
    assert link.twin.simulation.q[2] < 0.13  # and lies now
    assert link.twin.damped


def assert_damped(link, drive, path, cause, within, *, since=FAULT):
    """It was damped for this cause, and so soon; the log says so; it stayed so."""
    trip = drive.supervisor.trip
    assert trip is not None
    assert trip.cause == cause
    assert since - 1e-9 <= trip.t <= since + within
    assert link.damped_since is not None
    assert link.damped_since <= since + within + TICK
    _, records = read(path)
    assert CAUSES[records["trip"][-1] - 1] == cause
    assert str(cause) in records["why"][-1].decode()
    after = records[records["t"] > trip.t + TICK]
    assert "servo" not in {SENT[k] for k in after["sent"]}


def test_a_run_without_faults(tmp_path):
    brain = Standing()
    link, result, drive, path = run(tmp_path, brain=brain)
    assert_played(link, drive, path)
    assert result.missed == 0
    # The controller begins at the motion's first time, with the robot standing as it should.
    assert brain.started.t == pytest.approx(brain.motion.start, abs=0.005)
    assert np.abs(brain.started.q - brain.motion.first[7:]).max() < 0.1
    assert SENT[read(path)[1]["sent"][-1]] == "off"


@pytest.mark.parametrize("fraction", [pytest.param(0.01, marks=pytest.mark.slow), 0.05])
def test_a_few_packets_lost_both_ways_are_ridden_out(tmp_path, fraction):
    channels = dict(to_robot=lossy(fraction, seed=1), to_client=lossy(fraction, seed=2))
    link, result, drive, path = run(tmp_path, **channels)
    assert_played(link, drive, path)
    lost = 1 - result.counts["accepted"] / (link.now() * 500)
    assert lost == pytest.approx(fraction, abs=0.02)


def test_many_packets_lost(tmp_path):
    link, _, drive, path = run(tmp_path, to_client=lossy(0.2, since=FAULT))
    assert_damped(link, drive, path, Cause.LOSS, 0.8)


def test_a_silent_robot(tmp_path):
    link, _, drive, path = run(tmp_path, to_client=lossy(1.0, since=FAULT))
    assert_damped(link, drive, path, Cause.SILENT, 0.105)


def test_a_robot_that_never_answers(tmp_path):
    _, _, drive, path = run(tmp_path, to_client=lossy(1.0))
    assert drive.supervisor.trip.cause == Cause.SILENT
    assert drive.supervisor.trip.t <= 2.01
    assert "servo" not in {SENT[k] for k in read(path)[1]["sent"]}


def test_commands_that_do_not_arrive(tmp_path):
    """The robot's own watchdog."""
    link, _, _, _ = run(tmp_path, to_robot=lossy(1.0, since=FAULT))
    assert link.damped_since == pytest.approx(FAULT + 0.1, abs=0.006)


def test_a_delay_of_10_ms_is_ridden_out(tmp_path):
    slow = late(lambda t: 0.01)
    link, _, drive, path = run(tmp_path, to_client=slow, to_robot=slow)
    assert_played(link, drive, path)


def test_a_delay_that_grows(tmp_path):
    """Packets keep coming, so that it is not silence."""
    link, _, drive, path = run(tmp_path, to_client=late(lambda t: 0.5 * (t - FAULT), since=FAULT))
    assert_damped(link, drive, path, Cause.DELAYED, 0.31)


def test_a_delay_from_one_packet_to_the_next(tmp_path):
    link, _, drive, path = run(tmp_path, to_client=late(lambda t: 0.15, since=FAULT))
    assert_damped(link, drive, path, Cause.SILENT, 0.105)


def test_reordered_packets_are_ridden_out(tmp_path):
    rng = random.Random(3)
    mixed = late(lambda t: 0.0045 if rng.random() < 0.05 else 1e-4)
    link, result, drive, path = run(tmp_path, to_client=mixed, to_robot=mixed)
    assert_played(link, drive, path)
    assert result.counts["old"] > 20


@pytest.mark.slow
def test_duplicates_are_ridden_out(tmp_path):
    twice = lambda data, t: [*perfect(data, t), (data, t + 0.003, True)]  # noqa: E731
    link, result, drive, path = run(tmp_path, to_client=twice, to_robot=twice)
    assert_played(link, drive, path)
    assert result.counts["old"] == pytest.approx(result.counts["accepted"], abs=4)


def corrupt(fraction, *, since=0.0):
    rng = random.Random(4)

    def channel(data, t):
        if t >= since and rng.random() < fraction:
            data = bytearray(data)
            bit = rng.randrange(8 * 600)
            data[bit // 8] ^= 1 << bit % 8
        return perfect(bytes(data), t)

    return channel


def test_some_corrupted_packets_are_ridden_out(tmp_path):
    link, result, drive, path = run(tmp_path, to_client=corrupt(0.05), to_robot=corrupt(0.05))
    assert_played(link, drive, path)
    assert result.counts["crc"] > 30
    assert link.twin.counts["crc"] > 30


def test_many_corrupted_packets(tmp_path):
    link, _, drive, path = run(tmp_path, to_client=corrupt(0.5, since=FAULT))
    assert_damped(link, drive, path, Cause.LOSS, 0.4)


def test_packets_from_another_address(tmp_path):
    """States are not believed and commands not obeyed, however right they are."""
    seen = []

    def with_stranger(data, t):
        seen.append(data)
        return [*perfect(data, t), (seen[0], t + 2e-4, False)]

    link, result, drive, path = run(tmp_path, to_client=with_stranger, to_robot=with_stranger)
    assert_played(link, drive, path)
    assert result.counts["foreign"] > 1000
    assert link.twin.counts["foreign"] > 1000


def test_states_that_are_replayed_from_the_right_address(tmp_path):
    old = []

    def replay(data, t):
        old.append(data)
        return [*perfect(data, t), (old[len(old) // 2], t + 2e-4, True)]

    link, result, drive, path = run(tmp_path, to_client=replay)
    assert_played(link, drive, path)
    assert result.counts["old"] > 1000


class Failing(Standing):
    """Does something else than standing from 0.2 s into the motion on."""

    def __init__(self, answer):
        super().__init__()
        self.other, self.since = answer, self.motion.start + 0.2

    def answer(self, wait):
        if self.asked >= self.since:
            return self.other(super().answer(wait), self.asked - self.since)
        return super().answer(wait)

    def began(self, path):
        """s, on the run's clock, when it began to fail."""
        _, records = read(path)
        playing = records[records["phase"] == ORDER.index(Phase.PLAY)]
        return float(playing["t"][0] + self.since - playing["reference_t"][0])


def raising(error):
    def answer(reply, t):
        raise error

    return answer


@pytest.mark.parametrize("name", ["q", *(pytest.param(n, marks=pytest.mark.slow) for n in ("v", "tau", "kp", "kd"))])
def test_a_controller_that_gives_no_number(tmp_path, name):
    x = np.ones(12)
    x[7] = np.nan
    brain = Failing(lambda reply, t: replace(reply, command=replace(reply.command, **{name: x})))
    link, _, drive, path = run(tmp_path, brain=brain)
    assert_damped(link, drive, path, Cause.NUMBER, 2 * TICK, since=brain.began(path))
    assert "RR_thigh_joint" in str(drive.supervisor.trip) or "RL_thigh_joint" in str(drive.supervisor.trip)


def test_a_controller_that_is_late_for_a_while_is_held(tmp_path):
    brain = Failing(lambda reply, t: None if t < 0.04 else reply)
    link, _, drive, path = run(tmp_path, brain=brain)
    assert_played(link, drive, path)
    assert 15 <= read(path)[1]["held"].sum() <= 21


def test_a_controller_that_hangs(tmp_path):
    brain = Failing(lambda reply, t: None)
    link, _, drive, path = run(tmp_path, brain=brain)
    assert_damped(link, drive, path, Cause.LATE, QUICK.hold + 2 * TICK, since=brain.began(path))


def test_a_controller_that_ends(tmp_path):
    brain = Failing(raising(Died("it is gone")))
    link, _, drive, path = run(tmp_path, brain=brain)
    assert_damped(link, drive, path, Cause.DEAD, 2 * TICK, since=brain.began(path))


def test_an_error_in_the_program(tmp_path):
    brain = Failing(raising(RuntimeError("a bug")))
    link, error, drive, path = run(tmp_path, brain=brain)
    assert str(error) == "a bug"
    assert_damped(link, drive, path, Cause.ERROR, 2 * TICK, since=brain.began(path))


def test_a_loop_that_is_held_up(tmp_path):
    """The process itself was stopped for a while: the robot has repeated its last command for too long."""
    link, _, drive, path = run(tmp_path, do=lambda link: link.sleep_until(link.now() + 0.08))
    assert_damped(link, drive, path, Cause.LATE, 0.09)


def tip_over(link):
    q = link.twin.simulation.q
    q[2] += 0.1
    q[3:7] = [np.sin(np.radians(30)), 0, 0, np.cos(np.radians(30))]
    link.twin.simulation.reset(q)


def test_a_robot_that_tips_over(tmp_path):
    link, _, drive, path = run(tmp_path, do=tip_over)
    assert_damped(link, drive, path, Cause.TILT, 0.012)


def at_limit(link):
    q = link.twin.simulation.q
    q[7 + 2] = -2.80
    link.twin.simulation.reset(q)


def test_a_joint_at_its_limit(tmp_path):
    link, _, drive, path = run(tmp_path, do=at_limit)
    assert_damped(link, drive, path, Cause.POSITION, 0.012)
    assert "FL_calf_joint -2." in str(drive.supervisor.trip)


def test_a_robot_that_sinks(tmp_path):
    """The controller lets its knees go."""
    soft = lambda reply, t: replace(reply, command=replace(reply.command, tau=np.zeros(12), kp=np.zeros(12)))  # noqa: E731
    brain = Failing(soft)
    link, _, drive, path = run(tmp_path, brain=brain)
    assert_damped(link, drive, path, Cause.HEIGHT, 0.6, since=brain.began(path))


def reporting(**what):
    def do(link):
        link.twin.config = replace(link.twin.config, **what)

    return do


@pytest.mark.parametrize(
    ("what", "cause"),
    [
        ({"battery": 9}, Cause.BATTERY),
        pytest.param({"temperature": 95.0}, Cause.TEMPERATURE, marks=pytest.mark.slow),
    ],
)
def test_a_low_battery_or_a_hot_motor_leave_time_to_lie_down(tmp_path, what, cause):
    link, _, drive, path = run(tmp_path, do=reporting(**what))
    assert_damped(link, drive, path, cause, QUICK.lower + 0.02)
    assert phases(path)[-2:] == [Phase.LOWER, Phase.DAMP]
    _, records = read(path)
    down = records[records["phase"] == ORDER.index(Phase.LOWER)]
    assert down["t"][0] < FAULT + 0.02
    assert down["truth"][-1, 2] < 0.15


@pytest.mark.parametrize("what", [{"battery": 9}, {"temperature": 95.0}])
def test_it_does_not_stand_up_with_a_low_battery_or_a_hot_motor(tmp_path, what):
    _, _, drive, path = run(tmp_path, do=reporting(**what), at=0.01)
    assert drive.supervisor.trip.cause in (Cause.BATTERY, Cause.TEMPERATURE)
    assert phases(path) == [Phase.LISTEN, Phase.DAMP]


def test_the_remotes_stop_button(tmp_path):
    link, _, drive, path = run(tmp_path, do=lambda link: setattr(link.twin, "buttons", frozenset({"L2", "B"})))
    assert_damped(link, drive, path, Cause.STOP_KEY, 3 * TICK)


def test_a_signal(tmp_path):
    stopped = []
    do = lambda link: stopped.append((Cause.SIGNAL, "SIGTERM"))  # noqa: E731
    link, _, drive, path = run(tmp_path, do=do, stopped=lambda: stopped[0] if stopped else None)
    assert_damped(link, drive, path, Cause.SIGNAL, 2 * TICK)


def test_it_does_not_stand_up_on_its_side(tmp_path):
    _, _, drive, path = run(tmp_path, do=tip_over, at=0.01)
    assert drive.supervisor.trip.cause == Cause.TILT
    assert phases(path) == [Phase.LISTEN, Phase.DAMP]
