"""What the verifier found, for the screen: a table on a terminal, one line elsewhere."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from slomo.optimize.check import digits

if TYPE_CHECKING:
    from rich.table import Table

Check = Mapping[str, Any]

STATES = {"holds": "green", "warning": "yellow", "fails": "bold red"}


def state(check: Check) -> str:
    """ "holds", "warning" or "fails", of an entry of report.json's `checks`."""
    return "holds" if check["kept"] else "fails" if check["required"] else "warning"


def as_table(report: Mapping[str, Any]) -> "Table":
    """Every check with its worst value, its limit, where and when, what fails first."""
    from rich.table import Table
    from rich.text import Text

    verdict = "verified" if report["verified"] else "not verified"
    table = Table(title=f"{verdict}: {report['method']}, {report['status']}", title_justify="left", box=None)
    for name, justify in (("", "left"), ("check", "left"), ("worst", "right"), ("limit", "right"), ("where", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    table.add_column("t (s)", justify="right")
    order = list(STATES)
    for check in sorted(report["checks"], key=lambda c: -order.index(state(c))):
        how = state(check)
        at = (check["point"], f"{check['t']:.2f}") if check["value"] > 0 else ("", "")
        unit = f" {check['unit']}" if check["unit"] else ""
        value = f"{digits(check['value'], check['limit'])}{unit}"
        name = check["check"].replace("_", " ")
        table.add_row(Text(how, style=STATES[how]), name, value, f"{check['limit']:.3g}{unit}", *at)
    return table


def as_line(report: Mapping[str, Any]) -> str:
    """How many checks hold and which is nearest to its limit; warnings in full."""
    checks, worst = report["checks"], report["worst"]
    required = [c for c in checks if c["required"]]
    holding = sum(c["kept"] for c in required)
    parts = [
        f"{holding} of {len(required)} checks hold, "
        f"{'nearest to its limit' if report['verified'] else 'worst'} is {worst['check']} {_value(worst)}"
    ]
    parts += [f"warning: {c['check']} {_value(c)}" for c in checks if state(c) == "warning"]
    return "; ".join(parts)


def _value(check: Check) -> str:
    unit = f" {check['unit']}" if check["unit"] else ""
    value = digits(check["value"], check["limit"])
    return f"{value} of {check['limit']:.3g}{unit} ({check['point']}, t = {check['t']:.2f} s)"
