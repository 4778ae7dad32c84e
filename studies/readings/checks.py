"""How a figure is asked, measured and judged; and the command line called as a user does."""

from __future__ import annotations

import json

from studies.common.metrics import clopper_pearson
from studies.harness.command_line import call
from studies.harness.study import LEVEL, Row

Check = Row

# A mean is unbiased within so many of its standard errors, and a distribution is the one said to
# be if its test has such a p-value or a larger one: a right reading fails once in 10,000 studies.
STANDARD_ERRORS, P_VALUE = 4.0, 1e-4


def below(measured: float, limit: float) -> Check:
    """Ask for less than a limit."""
    measured = float(measured)
    return {"asked": f"below {limit:g}", "measured": measured, "passed": measured < limit}


def at_least(measured: float, limit: float) -> Check:
    """Ask for a limit or more."""
    return {"asked": f"at least {limit:g}", "measured": measured, "passed": measured >= limit}


def unbiased(measured: float, truth: float, error: float) -> Check:
    """Ask for the truth within some standard errors."""
    asked = f"{truth:.6g} within {STANDARD_ERRORS:g} standard errors"
    passed = bool(abs(measured - truth) < STANDARD_ERRORS * error)
    return {"asked": asked, "measured": measured, "standard_error": error, "passed": passed}


def likely(p_value: float, distribution: str) -> Check:
    """Ask for a distribution that a test does not reject."""
    asked = f"{distribution}: p above {P_VALUE:g}"
    return {"asked": asked, "measured": p_value, "passed": bool(p_value > P_VALUE)}


def rate(hits: int, trials: int, nominal: float) -> Check:
    """Ask for a rate whose Clopper-Pearson interval holds the nominal one."""
    low, high = clopper_pearson(hits, trials, LEVEL)
    asked = f"{nominal:g} inside its {100 * LEVEL:g} % Clopper-Pearson interval"
    return {"asked": asked, "measured": hits / trials, "interval": [low, high], "trials": trials,
            "passed": low <= nominal <= high}  # fmt: skip


def control(check: Check) -> Check:
    """Ask a check to fail."""
    asked = f"to be refused, which was: {check['asked']}"
    return check | {"asked": asked, "passed": not check["passed"]}


def command(*arguments: object, quick: bool) -> Row:
    """Call the command line, see `call`, and return the JSON that it prints."""
    content: Row = json.loads(call("lmshealth", *arguments, "--format", "json", quick=quick))
    return content
