"""One number of a reference beside what is allowed, and how a set of them reads: in report.json and on one line."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Check:
    """The worst value of one quantity, where it is, and what is allowed.

    Attributes:
        value, limit: in `unit`; the limit is kept when value <= limit.
        t: s, of the worst value.  point: which contact point, joint or part.
        required: whether going over the limit makes the reference unverified, or is only a warning.
    """

    value: float
    limit: float
    unit: str
    t: float
    point: str
    required: bool = True

    @property
    def kept(self) -> bool:
        """Whether the value is within its limit."""
        return bool(self.value <= self.limit)

    @property
    def holds(self) -> bool:
        """Whether the reference may count as verified as far as this goes."""
        return self.kept or not self.required


def worst(values: Array, limit: float, unit: str, t: Array, points: tuple[str, ...], *, required: bool = True) -> Check:
    """The largest of values (len(t), len(points)); a value that is not a number is the worst."""
    x = np.where(np.isfinite(values), values, np.inf)
    k, c = np.unravel_index(int(np.argmax(x)), x.shape)
    return Check(float(x[k, c]), limit, unit, float(t[k]), points[c], required)


def tightest(checks: Mapping[str, Check]) -> str:
    """Name of the required check that is nearest to its limit, or farthest beyond."""
    return max((n for n, c in checks.items() if c.required), key=lambda n: checks[n].value / checks[n].limit)


def as_report(checks: Mapping[str, Check]) -> dict[str, Any]:
    """The checks' part of report.json: `verified`, values by name, `limits`, `worst`, and all `checks` in full."""
    name = tightest(checks)
    rows = [{"check": n, **vars(c), "kept": c.kept} for n, c in checks.items()]
    return {
        "verified": all(c.holds for c in checks.values()),
        **{n: c.value for n, c in checks.items()},
        "limits": {n: c.limit for n, c in checks.items()},
        "worst": {"check": name, **vars(checks[name])},
        "checks": rows,
    }


def digits(value: float, limit: float) -> str:
    """The value with as many digits as it takes to see on which side of the limit it is, three at least."""
    for n in range(3, 16):
        text = f"{value:.{n}g}"
        if (float(text) > limit) == (value > limit):
            return text
    return repr(value)


def failure(checks: Mapping[str, Check]) -> str | None:
    """None, or one line that names what does not hold, the worst first, each with its place and time."""
    failed = sorted((n for n, c in checks.items() if not c.holds), key=lambda n: -checks[n].value / checks[n].limit)
    if not failed:
        return None
    parts = [
        f"{n} {digits(c.value, c.limit)} > {c.limit:.3g}{f' {c.unit}' if c.unit else ''} ({c.point}, t = {c.t:.2f} s)"
        for n, c in ((n, checks[n]) for n in failed)
    ]
    return f"the reference does not verify: {', '.join(parts)}"
