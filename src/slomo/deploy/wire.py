"""The low-level UDP format of the Unitree Go1, to the byte.

The tables are the specification. They were read off the vendor's own SDK (unitree-legged-sdk 3.8, which packs its C
structures `LowCmd` and `LowState` into fewer bytes), by giving it values and looking at what it sends and what it makes
of what it receives; `make conformance` does so again. No real robot has been asked.
"""

import zlib
from dataclasses import dataclass

import numpy as np

Array = np.ndarray

HEAD = (0xFE, 0xEF)
LOW_LEVEL = 0xFF
SERVO, DAMPING = 0x0A, 0x00  # a motor's mode
POSITION_STOP = 2.146e9  # rad, in `q`: no position control
VELOCITY_STOP = 16000.0  # rad/s, in `dq`: no velocity control
MOTORS = 20  # in the format; a Go1 has the first 12


@dataclass(frozen=True)
class Field:
    """One row: `count` numbers of NumPy type `type` at `offset` bytes; one unit of an integer stands for `unit`."""

    offset: int
    name: str
    type: str | np.dtype
    count: int
    unit: float
    meaning: str


def _layout(size: int, *rows: tuple) -> tuple[np.dtype, dict[str, float]]:
    """The packed NumPy type of a table and the units of its fields; the offsets must follow from the sizes."""
    fields = [Field(*row) for row in rows]
    dtype = np.dtype([(f.name, f.type, (f.count,)) if f.count > 1 else (f.name, f.type) for f in fields])
    assert dtype.itemsize == size
    assert [dtype.fields[f.name][1] for f in fields] == [f.offset for f in fields]  # type: ignore[index]
    return dtype, {f.name: f.unit for f in fields}


# Little endian throughout. Columns: offset, name, type, count, unit, meaning.
MOTOR_CMD, MOTOR_CMD_UNIT = _layout(
    27,
    (0, "mode", "u1", 1, 1, "SERVO or DAMPING"),
    (1, "q", "<f4", 1, 1, "rad, target; or POSITION_STOP"),
    (5, "dq", "<f4", 1, 1, "rad/s, target; or VELOCITY_STOP"),
    (9, "tau", "<i2", 1, 1 / 256, "N m, feed-forward"),
    (11, "Kp", "<i2", 1, 1 / 32, "N m/rad"),
    (13, "Kd", "<i2", 1, 1 / 16, "N m s/rad"),
    (15, "reserve", "<u4", 3, 1, ""),
)
LOW_CMD, _ = _layout(
    614,
    (0, "head", "u1", 2, 1, "HEAD"),
    (2, "level", "u1", 1, 1, "LOW_LEVEL"),
    (3, "frame_reserve", "u1", 1, 1, ""),
    (4, "sn", "<u4", 2, 1, "serial number; 0 from the SDK"),
    (12, "version", "<u4", 2, 1, "0 from the SDK"),
    (20, "bandwidth", "<u2", 1, 1, "0 from the SDK"),
    (22, "motor", MOTOR_CMD, MOTORS, 1, "FR, FL, RR, RL x hip, thigh, calf; then 8 unused"),
    (562, "bms_off", "u1", 1, 1, "0xA5 switches the battery off"),
    (563, "bms_reserve", "u1", 3, 1, ""),
    (566, "remote", "u1", 40, 1, ""),
    (606, "reserve", "<u4", 1, 1, "its last two bytes are outside of the CRC"),
    (610, "crc", "<u4", 1, 1, "see `crc`"),
)
MOTOR_STATE, MOTOR_STATE_UNIT = _layout(
    32,
    (0, "mode", "u1", 1, 1, ""),
    (1, "q", "<f4", 1, 1, "rad"),
    (5, "dq", "<f4", 1, 1, "rad/s"),
    (9, "ddq", "<i2", 1, 1, "rad/s^2"),
    (11, "tau", "<i2", 1, 1 / 256, "N m, estimate"),
    (13, "q_raw", "<f4", 1, 1, "rad"),
    (17, "dq_raw", "<f4", 1, 1, "rad/s"),
    (21, "ddq_raw", "<i2", 1, 1, "rad/s^2"),
    (23, "temperature", "i1", 1, 1, "degrees C"),
    (24, "reserve", "<u4", 2, 1, ""),
)
LOW_STATE, LOW_STATE_UNIT = _layout(
    807,
    (0, "head", "u1", 2, 1, "HEAD"),
    (2, "level", "u1", 1, 1, "LOW_LEVEL"),
    (3, "frame_reserve", "u1", 1, 1, ""),
    (4, "sn", "<u4", 2, 1, ""),
    (12, "version", "<u4", 2, 1, ""),
    (20, "bandwidth", "<u2", 1, 1, ""),
    (22, "quat_wxyz", "<f4", 4, 1, "attitude of the IMU"),
    (38, "gyro", "<f4", 3, 1, "rad/s, in the IMU's frame"),
    (50, "acceleration", "<f4", 3, 1, "m/s^2, specific force, in the IMU's frame"),
    (62, "rpy", "<f4", 3, 1, "rad"),
    (74, "imu_temperature", "i1", 1, 1, "degrees C"),
    (75, "motor", MOTOR_STATE, MOTORS, 1, "as in LOW_CMD"),
    (715, "bms_version", "u1", 2, 1, "high, low"),
    (717, "bms_status", "u1", 1, 1, ""),
    (718, "soc", "u1", 1, 1, "%, charge of the battery"),
    (719, "current", "<i4", 1, 1e-3, "A"),
    (723, "cycle", "<u2", 1, 1, "charging cycles"),
    (725, "bq_ntc", "i1", 2, 1, "degrees C"),
    (727, "mcu_ntc", "i1", 2, 1, "degrees C"),
    (729, "cell", "u1", 10, 0.032, "V, of each cell"),
    (739, "foot_force", "<i2", 4, 1, "FR, FL, RR, RL"),
    (747, "foot_force_est", "<i2", 4, 1, ""),
    (755, "tick", "<u4", 1, 1e-6, "s, the robot's clock; wraps"),
    (759, "remote", "u1", 40, 1, "buttons at bytes 2 and 3, see BUTTONS"),
    (799, "reserve", "<u4", 1, 1, "its last three bytes are outside of the CRC"),
    (803, "crc", "<u4", 1, 1, "see `crc`"),
)
# Bits of the little-endian u16 at byte 2 of `remote` (joystick.h of the SDK).
BUTTONS = ("R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left")


class Rejected(ValueError):
    """A datagram that is not a whole message; the text says why: length, header, level or crc."""


def new(dtype: np.dtype) -> Array:
    """An empty message () of LOW_CMD or LOW_STATE, its header filled in."""
    message = np.zeros((), dtype)
    message["head"], message["level"] = HEAD, LOW_LEVEL
    return message


def encode(message: Array, *, scrambled: bool = False) -> bytes:
    """The datagram of a message () of LOW_CMD or LOW_STATE, under its check sum."""
    data = bytearray(message.tobytes())
    value = crc(data)
    data[-4:] = (scramble(value) if scrambled else value).to_bytes(4, "little")
    return bytes(data)


def decode(data: bytes, dtype: np.dtype, *, scrambled: bool = False) -> Array:
    """The message () of LOW_CMD or LOW_STATE in a datagram. Raises `Rejected`, and nothing else, for any bytes."""
    if len(data) != dtype.itemsize:
        raise Rejected("length")
    if data[0] != HEAD[0] or data[1] != HEAD[1]:
        raise Rejected("header")
    if data[2] != LOW_LEVEL:
        raise Rejected("level")
    value = crc(data)
    if int.from_bytes(data[-4:], "little") != (scramble(value) if scrambled else value):
        raise Rejected("crc")
    return np.frombuffer(data, dtype)[0]


def to_counts(x: Array | float, unit: float) -> Array:
    """Physical values as 16-bit integers, rounded; beyond the range the nearest that there is (the SDK wraps round)."""
    return np.clip(np.rint(np.asarray(x) / unit), -32768, 32767).astype("<i2")


_REVERSED = bytes(int(f"{i:08b}"[::-1], 2) for i in range(256))


def crc(data: bytes | bytearray) -> int:
    """CRC-32/MPEG-2 (polynomial 0x04C11DB7, from all ones, not reflected) of the 32-bit words, the high byte of each
    first. There are size // 4 - 1 of them: what follows them, and the check sum itself, do not count.

    zlib's CRC is the reflected one of the same polynomial, so it takes the bits in reverse and gives them in reverse.
    """
    words = np.frombuffer(data, "<u4", len(data) // 4 - 1)
    reflected = zlib.crc32(words.byteswap().tobytes().translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")


def scramble(value: int) -> int:
    """A check sum as some public clients send it, and some firmware is said to want it: masked and turned by a byte."""
    masked = value ^ 0xEDCAB9DE
    return masked >> 8 | (masked & 0xFF) << 24
