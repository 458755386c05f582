"""Whether the service can work, looked at every few seconds: a request for it never touches the database."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from graspdb_service.problems import ProblemError

log = logging.getLogger("graspdb")

#: A look that takes longer hangs.
_HANGS_S = 6.0


@dataclass(frozen=True)
class Looked:
    """What was found, and when (monotonic seconds): what is well, or what is wrong."""

    at: float
    well: tuple[str, ...] = ()
    trouble: str | None = None
    blocks: bool = False
    """Whether nothing may be asked of the database until this is mended."""


class Health:
    """The last look at the database, by ``look``, which names what is well or raises."""

    def __init__(self, look: Callable[[], list[str]], seconds: float, *, may_hang: bool) -> None:
        self._look, self._seconds, self._may_hang = look, seconds, may_hang
        self._last = Looked(time.monotonic(), trouble="The service starts")
        self._starts = True
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._keep_looking, name="graspdb-health", daemon=True)

    def start(self) -> None:
        """Look once, and from then on in the background."""
        self._look_once()
        self._thread.start()

    def close(self) -> None:
        self._closed.set()

    @property
    def age_s(self) -> float:
        """Seconds since the last look began to be true."""
        return time.monotonic() - self._last.at

    @property
    def trouble(self) -> str | None:
        """What is wrong: what the last look found, or that there is none of late; None where all is well."""
        if self.age_s > self._seconds + _HANGS_S:
            return f"The database has not answered for {self.age_s:.0f} s"
        return self._last.trouble

    @property
    def is_stuck(self) -> bool:
        """Whether a look has not come back: the database hangs."""
        return self.age_s > self._seconds + _HANGS_S

    def down(self) -> str | None:
        """Why nothing may be asked of the database now; None where it may be."""
        if self.is_stuck and self._may_hang:
            return self.trouble or f"The database has not answered for {self.age_s:.0f} s"
        last = self._last
        return last.trouble if last.blocks else None

    def ready(self) -> dict[str, object]:
        """That the service is ready, how long ago that was found, and what was looked at; else 503."""
        last, age, trouble = self._last, self.age_s, self.trouble
        if trouble is not None:
            raise ProblemError(
                503,
                "not-ready",
                trouble,
                headers={"Retry-After": "2"},
                extra={"age_s": round(age, 3)},
            )
        return {"status": "ready", "age_s": round(age, 3), "checks": dict.fromkeys(last.well, "ok")}

    def _keep_looking(self) -> None:
        while not self._closed.wait(self._seconds):
            self._look_once()

    def _look_once(self) -> None:
        before = self._last.trouble
        try:
            found = Looked(time.monotonic(), tuple(self._look()))
        except Exception as error:
            line = (str(error).strip() or type(error).__name__).splitlines()[0]
            log.debug("the look at the database failed", exc_info=True)
            known = isinstance(error, RuntimeError)
            told = line if known else f"The database can't be used: {line}"
            blocks = getattr(error, "blocks", False) or "timeout" in line.lower()
            found = Looked(time.monotonic(), trouble=told, blocks=blocks)
        self._last = found
        if found.trouble != before and not self._starts:
            log.warning("%s", found.trouble or "The database can be used again")
        self._starts = False
