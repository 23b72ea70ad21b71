"""The Go1's wire format: what the vendor's SDK sends and understands, every value there and back, and rubbish."""

import random
import struct
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slomo.deploy import wire
from slomo.deploy.go1 import FEET, MOTOR_JOINTS, Go1, RobotState, truth
from slomo.errors import UsageError
from slomo.robot import load_robot
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorSample

LAYOUTS = {"LowCmd": wire.LOW_CMD, "LowState": wire.LOW_STATE}

# Sent by the SDK 3.8 (offset -> bytes, the others are zero): from InitCmdData ...
SENT_FIRST = {0: "feefff", **{22 + 27 * i: "0ab9d2ff4e00007a46" for i in range(20)}, 610: "e2f07f34"}
# ... and from a command that is set in `test_golden_command`.
SENT = {
    0: "feefff", 22: "0a0000c03f000020c000c860ffb0ff01", 41: "02", 45: "04030201", 319: "0a0000e8bf",
    327: "3fc0f8800210", 562: "a5", 566: bytes(range(40)).hex(), 606: "ddccbbaa09b48bc3",
}  # fmt: skip


def from_bytes(size, parts):
    data = bytearray(size)
    for offset, text in parts.items():
        part = bytes.fromhex(text)
        data[offset : offset + len(part)] = part
    return bytes(data)


@cache
def go1(scrambled=False):
    return Go1(load_robot("go1"), scrambled=scrambled)


def slow_crc(data):
    """CRC-32/MPEG-2 as it is defined, bit by bit."""
    value = 0xFFFFFFFF
    for word in struct.unpack_from(f"<{len(data) // 4 - 1}I", data):
        for bit in range(31, -1, -1):
            top = value >> 31 ^ word >> bit & 1
            value = value << 1 & 0xFFFFFFFF ^ (0x04C11DB7 if top else 0)
    return value


def test_sizes_and_offsets_are_the_vendors():
    assert {name: layout.itemsize for name, layout in LAYOUTS.items()} == {"LowCmd": 614, "LowState": 807}
    offset = lambda layout, name: layout.fields[name][1]  # noqa: E731
    assert [offset(wire.LOW_CMD, n) for n in ("motor", "bms_off", "remote", "crc")] == [22, 562, 566, 610]
    names = ("quat_wxyz", "motor", "bms_version", "foot_force", "tick", "remote", "crc")
    assert [offset(wire.LOW_STATE, n) for n in names] == [22, 75, 715, 739, 755, 759, 803]
    assert (wire.MOTOR_CMD.itemsize, wire.MOTOR_STATE.itemsize) == (27, 32)


def test_golden_commands():
    data = from_bytes(614, SENT)
    message = wire.decode(data, wire.LOW_CMD)
    first, last = message["motor"][0], message["motor"][11]
    unit = wire.MOTOR_CMD_UNIT
    assert (first["mode"], first["q"], first["dq"]) == (0x0A, 1.5, -2.5)
    assert first["tau"] * unit["tau"] == 200 - 256  # the SDK was given 200 and wraps round
    assert (first["Kp"] * unit["Kp"], first["Kd"] * unit["Kd"]) == (-5, -5)
    assert first["reserve"].tolist() == [1, 2, 0x01020304]
    assert (last["mode"], last["q"], last["dq"], last["tau"] * unit["tau"]) == (0x0A, -1.8125, 0.5, -7.25)
    assert (last["Kp"] * unit["Kp"], last["Kd"] * unit["Kd"]) == (20, 1)
    assert (message["bms_off"], message["remote"].tolist(), message["reserve"]) == (0xA5, list(range(40)), 0xAABBCCDD)
    assert wire.encode(message) == data

    data = from_bytes(614, SENT_FIRST)
    free = go1().command(data)
    assert free is not None
    assert not np.any([free.q, free.v, free.tau, free.kp, free.kd])
    message = wire.new(wire.LOW_CMD)
    message["motor"]["mode"], message["motor"]["q"], message["motor"]["dq"] = 0x0A, 2.146e9, 16000.0
    assert wire.encode(message) == data


def test_golden_state():
    """What the SDK made of these bytes (it also found their check sum right)."""
    parts = {
        0: "feefff", 4: "01000000020000000300000004000000", 20: "0500",
        22: np.arange(0.5, 13.5, dtype="<f4").tobytes().hex() + "fe",
        75: "0a0000c03f000020c0100000fe0000003f0000803e1000c80700000008000000",
        715: bytes(range(1, 25)).hex(), 739: np.arange(100, 108, dtype="<i2").tobytes().hex(), 755: "40e20100",
        759: bytes(range(40)).hex(), 799: "ddccbbaa",
    }  # fmt: skip
    data = bytearray(from_bytes(807, parts))
    struct.pack_into("<I", data, 803, slow_crc(data))
    message = wire.decode(bytes(data), wire.LOW_STATE)
    assert (message["sn"].tolist(), message["version"].tolist(), message["bandwidth"]) == ([1, 2], [3, 4], 5)
    assert message["quat_wxyz"].tolist() == [0.5, 1.5, 2.5, 3.5]
    assert message["gyro"].tolist() == [4.5, 5.5, 6.5]
    assert message["acceleration"].tolist() == [7.5, 8.5, 9.5]
    assert message["rpy"].tolist() == [10.5, 11.5, 12.5]
    assert message["imu_temperature"] == -2
    motor = message["motor"][0]
    assert [motor[n] for n in ("mode", "q", "dq", "ddq", "q_raw", "dq_raw", "ddq_raw")] == [
        10, 1.5, -2.5, 16, 0.5, 0.25, 16,
    ]  # fmt: skip
    assert motor["tau"] * wire.MOTOR_STATE_UNIT["tau"] == -2
    assert (motor["temperature"], motor["reserve"].tolist()) == (-56, [7, 8])
    assert (message["bms_version"].tolist(), message["bms_status"], message["soc"]) == ([1, 2], 3, 4)
    assert (message["current"], message["cycle"]) == (134678021, 2569)
    assert message["bq_ntc"].tolist() + message["mcu_ntc"].tolist() == [11, 12, 13, 14]
    millivolts = np.rint(message["cell"] * wire.LOW_STATE_UNIT["cell"] * 1e3)
    assert millivolts.tolist() == [480, 512, 544, 576, 608, 640, 672, 704, 736, 768]
    assert message["foot_force"].tolist() + message["foot_force_est"].tolist() == list(range(100, 108))
    assert (message["tick"], message["remote"].tolist(), message["reserve"]) == (123456, list(range(40)), 0xAABBCCDD)


def test_check_sum_is_crc32_mpeg2_of_the_words():
    assert slow_crc(b"4321" + b"8765" + bytes(4)) == zlib_free_reference()
    for size in (614, 807):
        data = random.Random(size).randbytes(size)
        assert wire.crc(data) == slow_crc(data)


def zlib_free_reference():
    """CRC-32/MPEG-2 of the bytes 12345678, by bytes."""
    value = 0xFFFFFFFF
    for byte in b"12345678":
        value ^= byte << 24
        for _ in range(8):
            value = (value << 1 ^ (0x04C11DB7 if value >> 31 else 0)) & 0xFFFFFFFF
    return value


def test_scrambled_check_sum():
    # 0x00000000 ^ 0xEDCAB9DE, its low byte (DE) to the front.
    assert wire.scramble(0) == 0xDEEDCAB9
    assert wire.scramble(0xEDCAB9DE) == 0
    data = wire.encode(wire.new(wire.LOW_CMD), scrambled=True)
    assert wire.encode(wire.decode(data, wire.LOW_CMD, scrambled=True), scrambled=True) == data
    with pytest.raises(wire.Rejected, match="crc"):
        wire.decode(data, wire.LOW_CMD)


@given(st.sampled_from(sorted(LAYOUTS)), st.booleans(), st.data())
def test_any_message_there_and_back(name, scrambled, data):
    layout = LAYOUTS[name]
    body = data.draw(st.binary(min_size=layout.itemsize, max_size=layout.itemsize))
    message = np.frombuffer(bytes(wire.HEAD) + bytes([wire.LOW_LEVEL]) + body[3:], layout)[0]
    sent = wire.encode(message, scrambled=scrambled)
    assert sent[:-4] == message.tobytes()[:-4]
    assert wire.decode(sent, layout, scrambled=scrambled).tobytes()[:-4] == message.tobytes()[:-4]


finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


def vectors(elements):
    return st.lists(elements, min_size=12, max_size=12).map(np.array)


@given(vectors(st.floats(-1e3, 1e3, width=32)), vectors(st.floats(-1e3, 1e3, width=32)),
       vectors(st.integers(-32768, 32767)), vectors(st.integers(0, 32767)), vectors(st.integers(0, 32767)))  # fmt: skip
def test_every_command_there_and_back(q, v, tau, kp, kd):
    command = JointCommand(q=q, v=v, tau=tau / 256, kp=kp / 32, kd=kd / 16)
    got = go1().command(go1().command_datagram(command))
    assert got is not None
    for name in ("q", "v", "tau", "kp", "kd"):
        np.testing.assert_array_equal(getattr(got, name), getattr(command, name))


@given(vectors(st.floats(-1e6, 1e6)))
def test_what_does_not_fit_is_the_nearest_that_does(tau):
    zero = np.zeros(12)
    got = go1().command(go1().command_datagram(JointCommand(zero, zero, tau, np.abs(tau), np.abs(tau))))
    assert got is not None
    np.testing.assert_allclose(got.tau, np.clip(tau, -128, 127.99609375), atol=0.5 / 256 + 1e-9)
    np.testing.assert_allclose(got.kp, np.clip(np.abs(tau), 0, 1023.96875), atol=0.5 / 32 + 1e-9)
    np.testing.assert_allclose(got.kd, np.clip(np.abs(tau), 0, 2047.9375), atol=0.5 / 16 + 1e-9)


@given(vectors(finite), vectors(finite), vectors(st.integers(-32768, 32767)), vectors(st.integers(-128, 127)),
       st.lists(finite, min_size=6, max_size=6), st.integers(0, 255), st.integers(0, 2**33),
       st.sets(st.sampled_from(wire.BUTTONS)), st.lists(st.integers(-9999, 9999), min_size=4, max_size=4))  # fmt: skip
def test_every_state_there_and_back(q, v, tau, temperature, imu, battery, tick, buttons, force):
    quat = np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9])
    sample = SensorSample(7.0, q, v, tau / 256, np.array(imu[:3]), np.array(imu[3:]), quat)
    state = RobotState(sample, tick, temperature.astype(float), np.array(force, float), battery, frozenset(buttons))
    data = go1().state_datagram(state)
    got = go1().state(data, 7.0)
    for name in ("q", "v", "tau", "gyro", "acceleration"):
        np.testing.assert_array_equal(getattr(got.sample, name), getattr(sample, name))
    np.testing.assert_allclose(got.sample.quat_xyzw, quat, atol=1e-7)
    np.testing.assert_array_equal(got.temperature, temperature)
    np.testing.assert_array_equal(got.foot_force, force)
    assert (got.tick, got.battery, got.buttons) == (tick % 2**32, battery, frozenset(buttons))
    assert truth(data) is None


def test_motors_are_found_by_name():
    """The first motor on the wire is the front right hip, whatever the model's order."""
    robot = load_robot("go1")
    assert robot.joint_names[0] == "FL_hip_joint"
    q = np.arange(12.0)
    zero = np.zeros(12)
    message = wire.decode(go1().command_datagram(JointCommand(q, zero, zero, zero, zero)), wire.LOW_CMD)
    by_name = dict(zip(robot.joint_names, q, strict=True))
    assert message["motor"]["q"][:12].tolist() == [by_name[name] for name in MOTOR_JOINTS]
    state = wire.new(wire.LOW_STATE)
    state["foot_force"] = [1, 2, 3, 4]
    state["motor"]["q"][:12] = np.arange(12)
    got = go1().state(wire.encode(state), 0.0)
    assert dict(zip(robot.foot_names, got.foot_force, strict=True)) == dict(zip(FEET, [1, 2, 3, 4], strict=True))
    assert dict(zip(robot.joint_names, got.sample.q, strict=True)) == dict(zip(MOTOR_JOINTS, range(12), strict=True))
    assert got.sample.quat_xyzw is None  # zeros are no attitude


@pytest.mark.parametrize("name", ["a1", "b1", "g1"])
def test_another_robot_is_refused(name):
    """The A1 and the B1 have the Go1's names of joints and feet, and limits of their own."""
    with pytest.raises(UsageError, match=rf"no wire format for '{name}' \(valid: go1\); .* begins with go1-"):
        Go1(load_robot(name))


def test_a_variant_of_the_go1_is_one():
    for name in ("go1-arm", "go1_heavy"):
        Go1(replace(load_robot("go1"), name=name))
    with pytest.raises(UsageError, match="no wire format for 'go12'"):
        Go1(replace(load_robot("go1"), name="go12"))
    with pytest.raises(UsageError, match=r"go1-tall: its joints or feet are not those of a Go1 \(valid: FR_hip_joint"):
        Go1(replace(load_robot("g1"), name="go1-tall"))


def test_damping_is_no_torque_at_rest():
    damping = go1().command(go1().damping_datagram())
    assert damping is not None
    assert not damping.kp.any()
    assert not damping.tau.any()
    assert (damping.kd == 3.0).all()
    assert go1().command(go1().off_datagram()) is None


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [("q", np.nan, "number"), ("dq", np.inf, "number"), ("mode", 3, "mode"), ("Kp", -1, "gain"), ("Kd", -1, "gain")],
)
def test_hostile_commands_under_a_right_check_sum(field, value, reason):
    message = wire.decode(go1().damping_datagram(), wire.LOW_CMD).copy()
    message["motor"][field][4] = value
    with pytest.raises(wire.Rejected, match=reason):
        go1().command(wire.encode(message))


@pytest.mark.parametrize("field", ["gyro", "acceleration", "quat_wxyz"])
def test_states_that_are_not_finite(field):
    message = wire.new(wire.LOW_STATE)
    message[field][1] = np.nan
    with pytest.raises(wire.Rejected, match="number"):
        go1().state(wire.encode(message), 0.0)


def rubbish(rng, layout):
    """A datagram that is random, or a whole one with something done to it, and whether it still is whole."""
    size = layout.itemsize
    kind = rng.randrange(6)
    if kind == 0:
        return rng.randbytes(rng.randrange(1500)), False
    data = bytearray(bytes(wire.HEAD) + bytes([wire.LOW_LEVEL]) + rng.randbytes(size - 3))
    if kind == 1:
        return bytes(data), False  # the check sum is wrong but for once in 2^32
    if rng.random() < 0.5:
        data[3:-4] = bytes(size - 7)
    struct.pack_into("<I", data, size - 4, wire.crc(data))
    before = bytes(data)
    if kind == 2:
        for _ in range(rng.randrange(1, 9)):
            bit = rng.randrange(8 * size)
            data[bit // 8] ^= 1 << bit % 8
    elif kind == 3:
        del data[rng.randrange(size) :]
    elif kind == 4:
        data += rng.randbytes(rng.randrange(1, 700))
    covered = 4 * (size // 4 - 1)
    same = len(data) == size and data[:covered] == before[:covered] and data[-4:] == before[-4:]
    return bytes(data), same  # kind 5: anything, but whole


def fuzz(count):
    rng = random.Random(0)
    accepted = 0
    for name, layout in LAYOUTS.items():
        read = go1().command if name == "LowCmd" else lambda data: go1().state(data, 0.0)
        for _ in range(count):
            data, whole = rubbish(rng, layout)
            try:
                got = read(data)
            except wire.Rejected:
                continue
            assert whole
            accepted += 1
            if accepted % 100 == 0:
                assert struct.unpack("<I", data[-4:])[0] == slow_crc(data)
            numbers = (
                () if got is None else (got.q, got.v, got.tau) if name == "LowCmd" else (got.sample.q, got.sample.v)
            )
            assert all(np.isfinite(x).all() for x in numbers)
    return accepted


def test_rubbish_is_rejected():
    assert fuzz(10_000) > 100


@pytest.mark.slow
def test_a_million_datagrams_of_rubbish_into_each_decoder():
    assert fuzz(1_000_000) > 10_000
