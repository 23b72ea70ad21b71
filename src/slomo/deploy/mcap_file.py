"""A run as an MCAP file, which Foxglove opens: JSON messages, each kind with its schema."""

import io
import json
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from mcap.writer import Writer

from slomo.deploy.log import SENT
from slomo.deploy.sequence import ORDER
from slomo.robot import Robot

Array = np.ndarray
Message = tuple[float, str, dict[str, Any]]  # s since the run began, topic, content

EVERY = 10  # records from one set of transforms to the next
INFO, ERROR = 2, 4  # levels of foxglove.Log


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_NUMBERS, _TEXTS = {"type": "array", "items": _NUMBER}, {"type": "array", "items": _TEXT}
_TIME = _object(sec={"type": "integer"}, nsec={"type": "integer"})
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_TRANSFORM = _object(
    timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
)
# Topic -> name and schema of its messages; the names "foxglove." are Foxglove's own.
TOPICS = {
    "/joints": ("slomo.JointStates", _object(name=_TEXTS, q=_NUMBERS, v=_NUMBERS, tau=_NUMBERS, temperature=_NUMBERS)),
    "/command": (
        "slomo.JointCommand",
        _object(sent=_TEXT, name=_TEXTS, q=_NUMBERS, v=_NUMBERS, tau=_NUMBERS, kp=_NUMBERS, kd=_NUMBERS),
    ),
    "/imu": ("slomo.Imu", _object(gyro=_VECTOR, acceleration=_VECTOR, orientation=_QUATERNION)),
    "/status": (
        "slomo.Status",
        _object(phase=_TEXT, late_ms=_NUMBER, age_ms=_NUMBER, battery=_NUMBER, mpc_ms=_NUMBER, rejected=_NUMBER),
    ),
    "/tf": ("foxglove.FrameTransforms", _object(transforms={"type": "array", "items": _TRANSFORM})),
    "/log": ("foxglove.Log", _object(timestamp=_TIME, level={"type": "integer"}, message=_TEXT, name=_TEXT)),
}


def to_mcap(records: Array, robot: Robot, *, started: float) -> bytes:
    """The file's bytes.

    Args:
        records: (N,) of `log.RECORD`.  started: s, Unix time at which the run began.
    """
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="", library="slomo")
    channels = {}
    for topic, (name, schema) in TOPICS.items():
        known = writer.register_schema(name=name, encoding="jsonschema", data=json.dumps(schema).encode())
        channels[topic] = writer.register_channel(topic=topic, message_encoding="json", schema_id=known)
    for number, (t, topic, content) in enumerate(_messages(records, robot, started)):
        ns = round((started + t) * 1e9)
        data = json.dumps(_finite(content), allow_nan=False).encode()
        writer.add_message(channels[topic], log_time=ns, publish_time=ns, sequence=number, data=data)
    writer.finish()
    return stream.getvalue()


def _messages(records: Array, robot: Robot, started: float) -> Iterator[Message]:
    names = list(robot.joint_names)
    data = robot.model.createData()
    phase, tripped = None, False
    for k, r in enumerate(records):
        t = float(r["t"])
        if r["tick"]:
            joints = {n: r[n].tolist() for n in ("q", "v", "tau", "temperature")}
            yield t, "/joints", {"name": names, **joints}
            yield t, "/imu", {
                "gyro": _vector(r["gyro"]), "acceleration": _vector(r["acceleration"]),
                "orientation": _quaternion(r["quat_xyzw"]),
            }  # fmt: skip
        wanted = {n: r[f"{n}_des"].tolist() for n in ("q", "v", "tau")} | {n: r[n].tolist() for n in ("kp", "kd")}
        yield t, "/command", {"sent": SENT[r["sent"]], "name": names, **wanted}
        yield t, "/status", {
            "phase": ORDER[r["phase"]], "late_ms": 1e3 * r["late"], "age_ms": 1e3 * (t - r["state_t"]),
            "battery": r["battery"], "mpc_ms": r["mpc_ms"], "rejected": r["rejected"],
        }  # fmt: skip
        if k % EVERY == 0 and r["tick"]:
            yield t, "/tf", {"transforms": list(_transforms(r, robot, data, _time(started + t)))}
        if r["phase"] != phase:
            phase = r["phase"]
            yield t, "/log", _log(started + t, INFO, f"phase: {ORDER[phase]}")
        if r["trip"] and not tripped:
            tripped = True
            yield t, "/log", _log(started + t, ERROR, r["why"].decode(errors="replace"))


def _transforms(r: Array, robot: Robot, data: pin.Data, time: dict[str, int]) -> Iterator[dict[str, Any]]:
    """Every link in the world: by the truth of a twin, else as estimated, else (before that) by the IMU's attitude."""
    root = r["truth"] if np.isfinite(r["truth"]).all() else r["q_est"][:7]
    if not root[3:].any():
        root = np.concatenate([np.zeros(3), r["quat_xyzw"]])
    if not np.isfinite(root).all():
        return
    pin.framesForwardKinematics(robot.model, data, np.concatenate([root, r["q"]]).astype(float))
    for frame, T in zip(robot.model.frames, data.oMf, strict=True):
        if frame.type == pin.FrameType.BODY:
            pose = pin.SE3ToXYZQUAT(T)
            yield {
                "timestamp": time, "parent_frame_id": "world", "child_frame_id": frame.name,
                "translation": _vector(pose[:3]), "rotation": _quaternion(pose[3:]),
            }  # fmt: skip


def _time(seconds: float) -> dict[str, int]:
    return {"sec": int(seconds), "nsec": int(seconds % 1 * 1e9)}


def _log(seconds: float, level: int, message: str) -> dict[str, Any]:
    return {"timestamp": _time(seconds), "level": level, "message": message, "name": "slomo deploy"}


def _vector(x: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, x), strict=True))


def _quaternion(x: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyzw", map(float, x), strict=True))


def _finite(x: Any) -> Any:
    """As JSON has it: NumPy's numbers as Python's, null for what is not finite."""
    if isinstance(x, dict):
        return {k: _finite(v) for k, v in x.items()}
    if isinstance(x, list):
        return [_finite(v) for v in x]
    if isinstance(x, np.generic):
        x = x.item()
    return None if isinstance(x, float) and not np.isfinite(x) else x
