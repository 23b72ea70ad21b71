"""What a user sees of the verifier: the table on a terminal, the line elsewhere, the plots."""

import io
import re

import pytest

from slomo.console import Console
from slomo.optimize.check import Check, as_report, digits, failure
from slomo.report import checks as shown

GOOD = {
    "dynamics_residual": Check(1e-15, 1e-6, "", 0.3, "body velocity"),
    "slip_per_second": Check(0.004, 0.01, "m/s", 1.25, "hind_left"),
    "body_error": Check(0.01, 0.015, "m", 0.5, "body", required=False),
}
WARNED = GOOD | {"body_error": Check(0.02, 0.015, "m", 0.5, "body", required=False)}
FAILED = WARNED | {"slip_per_second": Check(0.04, 0.01, "m/s", 1.25, "hind_left")}


def report(checks):
    return as_report(checks) | {"method": "DDP", "status": "converged"}


class Terminal(io.StringIO):
    def isatty(self):
        return True


def drawn(checks) -> str:
    console = Console(stream=Terminal())
    console.show(shown.as_table(report(checks)), "not this line")
    return re.sub(r"\x1b\[[\d;]*m", "", console.stream.getvalue())


def test_the_line_counts_and_names():
    assert shown.as_line(report(GOOD)) == (
        "2 of 2 checks hold, nearest to its limit is slip_per_second 0.004 of 0.01 m/s (hind_left, t = 1.25 s)"
    )
    assert shown.as_line(report(FAILED)) == (
        "1 of 2 checks hold, worst is slip_per_second 0.04 of 0.01 m/s (hind_left, t = 1.25 s); "
        "warning: body_error 0.02 of 0.015 m (body, t = 0.50 s)"
    )


def test_a_value_just_over_its_limit_reads_as_such():
    assert failure({"torque_ratio": Check(1.00002, 1.0, "", 0.5, "knee")}) == (
        "the reference does not verify: torque_ratio 1.00002 > 1 (knee, t = 0.50 s)"
    )
    assert [digits(x, 0.01) for x in (0.0100001, 0.00999999, 0.02, 0.01)] == ["0.0100001", "0.01", "0.02", "0.01"]


@pytest.mark.parametrize(("checks", "states"), [(GOOD, "holds"), (WARNED, "warning"), (FAILED, "fails")])
def test_the_table_begins_with_what_is_worst(checks, states):
    lines = [line.split() for line in drawn(checks).splitlines()]
    title, rows = " ".join(lines[0]), lines[2:]
    assert title == f"{'not verified' if states == 'fails' else 'verified'}: DDP, converged"
    assert len(rows) == 3
    assert any(states in cell for cell in rows[0])
    slip = next(" ".join(r) for r in rows if "slip" in r)
    assert "slip per second" in slip
    assert slip.endswith("0.01 m/s hind_left 1.25")


def test_elsewhere_it_is_a_line_and_quiet_is_quiet():
    for quiet, text in ((False, "a line\n"), (True, "")):
        console = Console(quiet=quiet, stream=io.StringIO())
        console.show(shown.as_table(report(GOOD)), "a line")
        assert console.stream.getvalue() == text
