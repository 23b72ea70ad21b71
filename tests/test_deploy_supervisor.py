"""The supervisor alone: every limit, what may be sent, and the path of standing up."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slomo.deploy.config import Config, check
from slomo.deploy.go1 import Go1, RobotState
from slomo.deploy.postures import Postures, blend, smooth
from slomo.deploy.receiver import Receiver
from slomo.deploy.supervisor import PERSISTENT, Cause, Supervisor
from slomo.errors import UsageError
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorSample
from twin_bench import go1

DT = 0.002
LEVEL = np.array([0, 0, 0, 1.0])


def state(t=0.0, *, q=None, v=None, tau=None, quat=LEVEL, **more):
    robot, zero = go1(), np.zeros(12)
    sample = SensorSample(
        t, robot.q_nominal[7:] if q is None else q, zero if v is None else v, zero if tau is None else tau, np.zeros(3),
        np.array([0, 0, 9.81]), quat,
    )  # fmt: skip
    made = RobotState(sample, round(t * 1e6) + 1, np.full(12, 40.0), np.full(4, 30.0), 80, frozenset())
    return replace(made, **more)


def seen(n=PERSISTENT, **what):
    """A supervisor of a standing robot that has seen a good state, and then n of these."""
    supervisor = Supervisor(go1(), Config(), lowest=0.25)
    supervisor.upright = True
    for k in range(5):
        supervisor.see(state(k * DT), k * DT)
    for k in range(5, 5 + n):
        supervisor.see(state(k * DT, **what), k * DT)
    return supervisor


def one(index, value):
    x = np.zeros(12)
    x[index] = value
    return x


def tilted(degrees):
    return np.array([np.sin(np.radians(degrees) / 2), 0, 0, np.cos(np.radians(degrees) / 2)])


LIMITS = [
    ({"v": one(2, 20.0)}, {"v": one(2, 20.2)}, Cause.VELOCITY),
    ({"v": one(0, -30.0)}, {"v": one(0, -30.2)}, Cause.VELOCITY),
    ({"tau": one(5, 44.0)}, {"tau": one(5, -45.0)}, Cause.TORQUE),
    ({"quat": tilted(49)}, {"quat": tilted(51)}, Cause.TILT),
    ({}, {"quat": None}, Cause.ATTITUDE),
]


@pytest.mark.parametrize(("good", "bad", "cause"), LIMITS)
def test_limits(good, bad, cause):
    assert seen(**good).trip is None
    assert seen(PERSISTENT - 1, **bad).trip is None
    trip = seen(**bad).trip
    assert trip is not None
    assert trip.cause == cause
    assert trip.t == pytest.approx((4 + PERSISTENT) * DT)


@pytest.mark.parametrize("joint", range(12))
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_position_limits_are_the_tighter_of_urdf_and_vendor(joint, side):
    vendor = np.array([[-1.047, 1.047], [-0.663, 2.966], [-2.721, -0.837]])[joint % 3]
    urdf = np.array([go1().model.lowerPositionLimit[7 + joint], go1().model.upperPositionLimit[7 + joint]])
    limit = max(vendor[0], urdf[0]) if side == "lower" else min(vendor[1], urdf[1])
    out = -1 if side == "lower" else 1
    for beyond, trips in ((0.015, False), (0.025, True)):
        q = go1().q_nominal[7:].copy()
        q[joint] = limit + out * beyond
        supervisor = seen(q=q)
        supervisor.upright = False
        assert (supervisor.trip is not None and supervisor.trip.cause == Cause.POSITION) == trips


def test_a_joint_that_is_folded_up_at_first_may_be_outside_until_it_was_inside():
    folded = go1().q_nominal[7:].copy()
    folded[2::3] = -2.83
    supervisor = Supervisor(go1(), Config(), lowest=0.25)
    for k in range(10):
        supervisor.see(state(k * DT, q=folded), k * DT)
    assert supervisor.trip is None
    supervisor.see(state(10 * DT), 10 * DT)
    for k in range(11, 14):
        supervisor.see(state(k * DT, q=folded), k * DT)
    assert supervisor.trip.cause == Cause.POSITION


def test_power_is_averaged():
    work = {"v": np.full(12, 10.0), "tau": np.full(12, 10.0)}  # 1200 W
    assert seen(15, **work).trip is None
    assert seen(25, **work).trip.cause == Cause.POWER


def test_height_counts_while_it_should_stand():
    crouched = Postures(go1()).descent(go1().q_nominal).joints[-1]
    supervisor = seen(q=crouched)
    assert supervisor.trip.cause == Cause.HEIGHT
    assert 0.05 < float(supervisor.trip.detail.split()[0]) < 0.13
    supervisor = Supervisor(go1(), Config(), lowest=0.25)
    for k in range(9):
        supervisor.see(state(k * DT, q=crouched), k * DT)
    assert supervisor.trip is None


def test_the_first_trip_stays_and_nothing_is_let_through_any_more():
    supervisor = seen(quat=tilted(60))
    supervisor.stop(Cause.SIGNAL, 1.0, "")
    assert supervisor.trip.cause == Cause.TILT
    zero = np.zeros(12)
    assert supervisor.allow(JointCommand(zero, zero, zero, zero, zero), 0.1) is None


def test_a_clock_that_runs_wrong():
    supervisor = Supervisor(go1(), Config(), lowest=0.25)
    for k in range(250):
        supervisor.see(state(k * DT, tick=k * 1000), k * DT)
    supervisor.ready(250 * DT)
    assert supervisor.trip.cause == Cause.CLOCK


def test_it_stands_up_only_from_rest():
    for fast, cause in ((0.5, None), (1.5, Cause.NOT_AT_REST)):
        supervisor = Supervisor(go1(), Config(), lowest=0.25)
        for k in range(250):
            supervisor.see(state(k * DT, v=one(3, fast)), k * DT)
        supervisor.ready(250 * DT)
        assert (supervisor.trip.cause if supervisor.trip else None) == cause


vectors = st.lists(st.floats(-1e4, 1e4), min_size=12, max_size=12).map(np.array)
gains = st.lists(st.floats(0, 1e3), min_size=12, max_size=12).map(np.array)


@settings(max_examples=50)
@given(st.lists(st.tuples(vectors, vectors, vectors, gains, gains), min_size=1, max_size=5))
def test_whatever_is_asked_for_what_is_sent_is_within_all_limits(commands):
    supervisor, robot, config = seen(0), go1(), Config()
    s, last, now = supervisor.state.sample, supervisor.state.sample.q, 0.1
    for q, v, tau, kp, kd in commands:
        now += DT
        sent = supervisor.allow(JointCommand(q, v, tau, kp, kd), now)
        assert sent is not None
        assert np.all((sent.q >= robot.lower - 1e-9) & (sent.q <= robot.upper + 1e-9))
        assert np.all(np.abs(sent.q - last) <= config.max_joint_rate * config.hold + 1e-9)
        assert np.all(np.abs(sent.v) <= robot.velocity)
        total = sent.kp * (sent.q - s.q) + sent.kd * (sent.v - s.v) + sent.tau
        assert np.all(np.abs(total) <= robot.effort * (1 + 1e-9) + 1e-6)
        last = sent.q


def test_targets_and_torques_change_no_faster_than_allowed():
    supervisor, config = seen(0), Config()
    q0, zero = supervisor.state.sample.q, np.zeros(12)
    first = supervisor.allow(JointCommand(q0, zero, zero, zero, zero), 1.0)
    np.testing.assert_allclose(first.q, q0)
    second = supervisor.allow(JointCommand(q0 - 0.5, zero, np.full(12, 22.0), zero, zero), 1.0 + DT)
    np.testing.assert_allclose(second.q, q0 - config.max_joint_rate * DT)
    np.testing.assert_allclose(second.tau, config.max_torque_rate * DT)
    third = supervisor.allow(JointCommand(q0 - 0.5, zero, np.full(12, 22.0), zero, zero), 1.0 + 2 * DT)
    np.testing.assert_allclose(third.tau, 22.0)


def test_a_held_command_does_not_move_on():
    supervisor = seen(0)
    q0, one_, zero = supervisor.state.sample.q, np.ones(12), np.zeros(12)
    sent = supervisor.allow(JointCommand(q0, one_, zero, one_, one_), 1.0)
    held = supervisor.allow(None, 1.0 + DT)
    assert not held.v.any()
    np.testing.assert_array_equal(held.q, sent.q)


@pytest.mark.parametrize(("name", "value"), [("stale", 0.2), ("hold", 0.0), ("listen", 0.1), ("min_battery", -1.0)])
def test_parameters_out_of_range(name, value):
    with pytest.raises(UsageError, match=f"deploy.{name}"):
        check(replace(Config(), **{name: value}))
    check(Config())


def datagram(tick, go=None):
    made = state(0.0)
    return Go1(go1()).state_datagram(replace(made, tick=tick))


def test_states_are_taken_in_order_and_once_and_over_the_wrap_of_the_clock():
    receiver = Receiver(Go1(go1()))
    start = 2**32 - 5000
    got = [receiver.take(datagram(start + n), t) for n, t in ((0, 0.0), (2000, 0.002), (2000, 0.0021), (0, 0.003))]
    assert [x is not None for x in got] == [True, True, False, False]
    wrapped = receiver.take(datagram(start + 8000), 0.008)
    assert wrapped is not None
    assert wrapped.tick == 3000
    assert receiver.counts == {"accepted": 3, "old": 2}


def test_a_delayed_state_counts_as_old_as_it_is():
    receiver = Receiver(Go1(go1()))
    for k in range(10):
        receiver.take(datagram(2000 * k), 0.002 * k + 0.001)
    late = receiver.take(datagram(2000 * 10), 0.002 * 10 + 0.051)
    assert late.sample.t == pytest.approx(0.002 * 10 + 0.001, abs=1e-4)


def test_the_descent_keeps_the_feet_where_they_are():
    robot = go1()
    descent = Postures(robot).descent(robot.q_nominal)
    data, ids = robot.model.createData(), [robot.model.getFrameId(n) for n in robot.foot_names]
    heights, places = [], []
    for joints in descent.joints:
        pin.framesForwardKinematics(robot.model, data, np.concatenate([robot.q_nominal[:7], joints]))
        feet = np.array([data.oMf[i].translation for i in ids])
        heights.append(-feet[:, 2].mean())
        places.append(feet[:, :2])
    assert np.all(np.diff(heights) < 0)
    assert heights[0] - heights[-1] > 0.13
    assert np.abs(np.array(places) - places[0]).max() < 0.005
    # The torques carry the weight: foot forces that sum to it.
    q = np.concatenate([robot.q_nominal[:7], descent.joints[0]])
    J = pin.computeJointJacobians(robot.model, data, q) is not None and [
        pin.getFrameJacobian(robot.model, data, i, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[2, 6:] for i in ids
    ]
    forces = np.linalg.lstsq(-np.array(J).T, descent.tau[0], rcond=None)[0]
    assert forces.sum() == pytest.approx(robot.mass * 9.81, rel=1e-6)


def test_smooth_and_blend():
    for s in (0.0, 0.3, 1.0):
        rise = (smooth(s + 1e-6)[0] - smooth(s - 1e-6)[0]) / 2e-6
        assert smooth(s)[1] == pytest.approx(rise, abs=1e-5)
    a, b = (JointCommand(*(np.full(12, x + k) for k in range(5))) for x in (0.0, 10.0))
    assert blend(a, b, 0.25).kd[0] == pytest.approx(6.5)
