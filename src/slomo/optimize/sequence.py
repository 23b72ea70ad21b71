"""The contact sequence that an optimisation found: which point stands when. Nothing prescribes it."""

from typing import Any

import numpy as np

from slomo.motion import Reference
from slomo.optimize.verify_ground import LOADED, normal_and_tangential
from slomo.runs import runs
from slomo.terrain import Terrain

Array = np.ndarray


def in_contact(reference: Reference, terrain: Terrain) -> Array:
    """(T - 1, C) whether each point carries a normal force over `LOADED` in each step."""
    return normal_and_tangential(reference.points, reference.lam, terrain)[0] > LOADED


def contact_sequence(reference: Reference, terrain: Terrain, *, names: tuple[str, ...]) -> dict[str, Any]:
    """The sequence, ready for JSON.

    Returns:
        `contacts`: for each point its name, `intervals` [[start, end], ...] in s, and `duty_factor`, the share of the
        duration that it stands.  `touchdowns`: [{t, point}, ...] in order of time, without those at the start.
    """
    on, t = in_contact(reference, terrain), np.round(reference.t, 6).tolist()
    duration = t[-1] - t[0]
    contacts: list[dict[str, Any]] = []
    touchdowns: list[dict[str, Any]] = []
    for c, name in enumerate(names):
        intervals = [[t[a], t[b]] for a, b in runs(on[:, c])]
        stands = sum(b - a for a, b in intervals)
        contacts.append({"point": name, "intervals": intervals, "duty_factor": stands / duration})
        touchdowns += [{"t": a, "point": name} for a, _ in intervals if a > t[0]]
    return {"contacts": contacts, "touchdowns": sorted(touchdowns, key=lambda event: event["t"])}
