"""The wire format against the vendor's own SDK, on loopback: `make conformance`.

unitree-legged-sdk is a closed binary for CPython 3.11 on x86-64 Linux, and no dependency of slomo; without it these
tests are skipped.
"""

import socket
import time

import numpy as np
import pytest

from slomo.deploy import wire
from slomo.deploy.go1 import Go1, RobotState
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorSample
from twin_bench import go1

sdk = pytest.importorskip("unitree_legged_sdk.robot_interface", reason="the vendor's SDK is not installed")

LOW_LEVEL, LOOPBACK = 0xFF, "127.0.0.1"
N = 12


class Vendor:
    """The SDK's client, and our end of its wire."""

    def __init__(self):
        self.robot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.robot.bind((LOOPBACK, 0))
        self.robot.settimeout(2)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((LOOPBACK, 0))
            self.port = probe.getsockname()[1]
        self.udp = sdk.UDP(LOW_LEVEL, self.port, LOOPBACK, self.robot.getsockname()[1])
        self.command, self.state = sdk.LowCmd(), sdk.LowState()
        self.udp.InitCmdData(self.command)

    def send(self):
        """What its command looks like on the wire."""
        self.udp.SetSend(self.command)
        self.udp.Send()
        return self.robot.recvfrom(2048)[0]

    def receive(self, data):
        """The SDK's verdict on a datagram, and the state it has then."""
        self.send()
        self.robot.sendto(data, (LOOPBACK, self.port))
        time.sleep(0.02)
        verdict = self.udp.Recv()
        self.udp.GetRecv(self.state)
        return verdict, self.state


@pytest.fixture(scope="module")
def vendor():
    made = Vendor()
    yield made
    made.robot.close()


def random_command(rng):
    return JointCommand(
        q=rng.integers(-3000, 3000, N) / 1024, v=rng.integers(-20000, 20000, N) / 1024,
        tau=rng.integers(-32768, 32768, N) / 256, kp=rng.integers(0, 32768, N) / 32, kd=rng.integers(0, 32768, N) / 16,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
def test_our_command_is_to_the_byte_what_the_sdk_sends(vendor, seed):
    rng = np.random.default_rng(seed)
    command, order = random_command(rng), Go1(go1())._joint
    # Motors that the robot does not have are zero in ours; InitCmdData does not leave them so.
    for motor in vendor.command.motorCmd[N:]:
        motor.mode, motor.q, motor.dq = 0, 0.0, 0.0
    for i, joint in enumerate(order):
        motor = vendor.command.motorCmd[i]
        motor.mode = wire.SERVO
        motor.q, motor.dq, motor.tau = command.q[joint], command.v[joint], command.tau[joint]
        motor.Kp, motor.Kd = command.kp[joint], command.kd[joint]
    assert Go1(go1()).command_datagram(command) == vendor.send()


@pytest.mark.parametrize("seed", range(20))
def test_the_sdk_reads_our_state(vendor, seed):
    rng = np.random.default_rng(seed)
    sample = SensorSample(
        t=0.0, q=rng.uniform(-3, 3, N), v=rng.uniform(-20, 20, N), tau=rng.integers(-9000, 9000, N) / 256,
        gyro=rng.normal(size=3), acceleration=rng.normal(size=3), quat_xyzw=np.array([0.1, 0.2, 0.3, 0.927362]),
    )  # fmt: skip
    buttons = frozenset(rng.choice(wire.BUTTONS, 3))
    state = RobotState(
        sample, int(rng.integers(2**32)), rng.integers(-128, 128, N).astype(float),
        rng.integers(-500, 500, 4).astype(float), int(rng.integers(101)), buttons,
    )  # fmt: skip
    verdict, got = vendor.receive(Go1(go1()).state_datagram(state))
    assert verdict == 0
    for i, joint in enumerate(Go1(go1())._joint):
        motor = got.motorState[i]
        assert motor.q == pytest.approx(sample.q[joint], rel=1e-6)
        assert motor.dq == pytest.approx(sample.v[joint], rel=1e-6)
        assert motor.tauEst == sample.tau[joint]
        assert motor.temperature == state.temperature[joint]
    assert got.imu.gyroscope == pytest.approx(sample.gyro.tolist(), rel=1e-6)
    assert got.imu.accelerometer == pytest.approx(sample.acceleration.tolist(), rel=1e-6)
    assert got.imu.quaternion == pytest.approx(sample.quat_xyzw[[3, 0, 1, 2]].tolist(), rel=1e-6)
    assert (got.tick, got.bms.SOC) == (state.tick, state.battery)
    assert got.footForce == [
        state.foot_force[go1().foot_names.index(f"{leg}_foot")] for leg in ("FR", "FL", "RR", "RL")
    ]
    assert int.from_bytes(bytes(got.wirelessRemote[2:4]), "little") == sum(
        1 << wire.BUTTONS.index(name) for name in buttons
    )


def test_the_sdk_refuses_a_wrong_or_scrambled_check_sum(vendor):
    message = wire.new(wire.LOW_STATE)
    message["soc"] = 42
    assert vendor.receive(wire.encode(message))[1].bms.SOC == 42
    message["soc"] = 43
    wrong = bytearray(wire.encode(message))
    wrong[-1] ^= 1
    for bad in (bytes(wrong), wire.encode(message, scrambled=True)):
        verdict, got = vendor.receive(bad)
        assert verdict != 0
        assert got.bms.SOC == 42


def test_the_sdk_s_position_limits_are_those_in_robot_toml(vendor):
    """`PositionLimit` clamps; ours are its limits where the URDF's are not tighter."""
    safety = sdk.Safety(sdk.LeggedType.Go1)
    found = np.empty((N, 2))
    for side, far in enumerate((-9.0, 9.0)):
        for motor in vendor.command.motorCmd[:N]:
            motor.mode, motor.q = wire.SERVO, far
        safety.PositionLimit(vendor.command)
        found[:, side] = [motor.q for motor in vendor.command.motorCmd[:N]]
    order = Go1(go1())._joint
    assert np.all(go1().lower[order] >= found[:, 0] - 1e-3)
    assert np.all(go1().upper[order] <= found[:, 1] + 1e-3)
