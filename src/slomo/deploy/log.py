"""The flight recorder: a ring of fixed records in a memory-mapped file, so that it survives the process's death.

The file is a header of HEADER bytes (JSON: what was run with what) and then `capacity` records; record number n is at
n % capacity. Each record has a check sum of its own, so that one that was being written is left out.
"""

import json
import mmap
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slomo.deploy.config import HZ
from slomo.errors import InvalidData
from slomo.store import writing

Array = np.ndarray

HEADER = 1 << 16
MAGIC = "slomo deploy log 1"
SECONDS = 180  # that it holds; what is older is overwritten
NJ, C = 12, 4

RECORD = np.dtype(
    [
        ("check", "<u4"),
        ("number", "<u8"),  # from 1
        ("t", "<f8"),  # s since the run began
        ("late", "<f4"),  # s, how late the tick began
        ("phase", "u1"),  # index into sequence.ORDER
        ("trip", "u1"),  # 0, or 1 + index into supervisor.CAUSES
        ("why", "S120"),  # the trip in words, UTF-8
        ("reference_t", "<f8"),  # s on the motion's clock, nan before it
        # The newest state: when it was measured (s since the run began), and what it says.
        ("state_t", "<f8"),
        ("tick", "<u4"),
        ("q", "<f4", NJ),
        ("v", "<f4", NJ),
        ("tau", "<f4", NJ),
        ("temperature", "i1", NJ),
        ("gyro", "<f4", 3),
        ("acceleration", "<f4", 3),
        ("quat_xyzw", "<f4", 4),
        ("foot_force", "<f4", C),
        ("battery", "u1"),
        ("truth", "<f8", 7),  # root's position and quat_xyzw, from a twin; else nan
        # What was sent.
        ("sent", "u1"),  # index into SENT
        ("q_des", "<f4", NJ),
        ("v_des", "<f4", NJ),
        ("tau_des", "<f4", NJ),
        ("kp", "<f4", NJ),
        ("kd", "<f4", NJ),
        # What the controller thought.
        ("q_est", "<f8", 7 + NJ),
        ("v_est", "<f8", 6 + NJ),
        ("mpc_t", "<f8"),
        ("mpc_ms", "<f4"),
        ("mpc_status", "i1"),
        ("held", "u1"),  # 1: the controller had no new command
        ("accepted", "<u4"),  # datagrams so far
        ("rejected", "<u4"),
    ]
)
SENT = ("nothing", "servo", "damping", "off")
_CHECKED = RECORD.fields["check"][0].itemsize  # type: ignore[index]


class Log:
    """Writes records.

    Args:
        path: new file.  header: JSON object.  seconds: that the ring holds.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], *, seconds: float = SECONDS):
        text = json.dumps({"magic": MAGIC, "hz": HZ, **header}, allow_nan=False).encode()
        if len(text) > HEADER:
            raise ValueError(f"a header of {len(text)} bytes does not fit")
        self.path, self.capacity = path, round(seconds * HZ)
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "xb+") as f:
                f.write(text.ljust(HEADER))
                f.flush()
                # Space is taken now: a full disk must not end the process (SIGBUS) while it holds a robot.
                os.posix_fallocate(f.fileno(), 0, HEADER + self.capacity * RECORD.itemsize)
                self._map = mmap.mmap(f.fileno(), 0)
        self._number = 0
        self.record = np.zeros((), RECORD)

    def append(self) -> None:
        """Write `record`, which the caller has filled in."""
        self._number += 1
        self.record["number"] = self._number
        data = self.record.tobytes()[_CHECKED:]
        at = HEADER + (self._number - 1) % self.capacity * RECORD.itemsize
        self._map[at : at + RECORD.itemsize] = zlib.crc32(data).to_bytes(4, "little") + data

    def close(self) -> None:
        """To the disk, without the part of the ring that was never reached."""
        self._map.flush()
        self._map.close()
        os.truncate(self.path, HEADER + min(self._number, self.capacity) * RECORD.itemsize)


def read(path: Path) -> tuple[dict[str, Any], Array]:
    """Header and records (N,) of RECORD, in order, of a log that may have been cut off at any time.

    Raises:
        InvalidData: not such a file, or nothing in it.
    """
    try:
        with open(path, "rb") as f:
            header = json.loads(f.read(HEADER))
            body = f.read()
    except OSError as e:
        raise InvalidData(e.strerror or "cannot be read", where=path) from None
    except ValueError:
        header = None
    if not isinstance(header, dict) or header.get("magic") != MAGIC:
        raise InvalidData("is not a log of `slomo deploy`", where=path)
    records = np.frombuffer(body, RECORD, len(body) // RECORD.itemsize)
    records = records[records["number"] > 0]
    whole = [zlib.crc32(r.tobytes()[_CHECKED:]) == r["check"] for r in records]
    records = np.sort(records[whole], order="number")
    if not len(records):
        raise InvalidData("has no whole record", where=path)
    return header, records
