"""How a file's scores become outcomes: by one rule, which is stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graspdb.interop.grasps import Codes, Floats
from graspdb.wire import OUTCOME_CODES, OUTCOMES

SUCCESS, FAILURE, COLLISION = (OUTCOME_CODES[name] for name in ("success", "failure", "collision"))

WORDS = {
    **dict.fromkeys(("1", "1.0", "true", "t", "yes", "y", "passed"), SUCCESS),
    **dict.fromkeys(("0", "0.0", "false", "f", "no", "n", "failed"), FAILURE),
}
"""What else says an outcome."""


@dataclass(frozen=True)
class Rule:
    """A grasp is a success where a quality is above, or below, a limit."""

    quality: str
    limit: float
    below: bool = False

    def __str__(self) -> str:
        side = "below" if self.below else "above"
        return f"success where {self.quality} is {side} {self.limit:g}, else failure"

    def codes(self, values: Floats) -> Codes:
        """Outcomes by the rule (N,)."""
        held = values < self.limit if self.below else values > self.limit
        return np.where(held, SUCCESS, FAILURE).astype(np.uint8)


def rule_of(quality: str | None, above: float | None, below: float | None) -> Rule | None:
    """The rule that somebody states; None where nobody does, ValueError for half of one."""
    if quality is None and above is None and below is None:
        return None
    if quality is None or (above is None) == (below is None):
        raise ValueError(
            "a rule is a quality and one limit: give --success-from QUALITY with --success-above X, or with"
            " --success-below X where a lower score is better"
        )
    limit = float(below if above is None else above)  # type: ignore[arg-type]
    if not np.isfinite(limit):
        raise ValueError(f"the limit of success is {limit}; expected a finite number")
    return Rule(quality, limit, below is not None)


def code_of(value: object) -> int | None:
    """The code of one outcome as files have it: a name, a truth value, 1 or 0; None for anything else."""
    if isinstance(value, (bool, np.bool_)):
        return SUCCESS if value else FAILURE
    if isinstance(value, (int, float, np.integer, np.floating)):
        return {1.0: SUCCESS, 0.0: FAILURE}.get(float(value))
    text = str(value).strip().lower()
    return OUTCOME_CODES.get(text, WORDS.get(text))


def named(outcome: str) -> int:
    """The code of an outcome's name; ValueError for none."""
    if outcome not in OUTCOME_CODES:
        raise ValueError(f"outcome is {outcome!r}; expected one of {', '.join(OUTCOMES)}")
    return OUTCOME_CODES[outcome]
