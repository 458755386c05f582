"""How often a key may ask: a bucket of requests each, in this process."""

from __future__ import annotations

import math
import time

from graspdb_service.principal import Principal
from graspdb_service.problems import ProblemError


class Rates:
    """Buckets by key, filled at ``requests_per_s`` up to ``burst`` unless the key has its own.

    Called by the event loop alone. Each replica counts for itself.
    """

    def __init__(self, requests_per_s: float, burst: int) -> None:
        self._requests_per_s = requests_per_s
        self._burst = burst
        self._buckets: dict[str, tuple[float, float]] = {}

    def take(self, who: Principal) -> None:
        """Count a request; 429 where the key's bucket is empty."""
        rate = who.requests_per_s or self._requests_per_s
        burst = who.burst or self._burst
        now = time.monotonic()
        left, since = self._buckets.get(who.key_id, (float(burst), now))
        left = min(float(burst), left + (now - since) * rate)
        if left < 1.0:
            self._buckets[who.key_id] = left, now
            wait_s = math.ceil((1.0 - left) / rate)
            raise ProblemError(
                429,
                "rate-limited",
                f"The key {who.name!r} may make {rate:g} requests a second, {burst} at once: wait, or send"
                " more in one request (many trials in a batch, many poses in a question)",
                headers={"Retry-After": str(max(1, wait_s))},
            )
        self._buckets[who.key_id] = left - 1.0, now
