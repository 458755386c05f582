"""The real child, with one pose made deadly: ``faulty_child.py crash|hang|spin|raise X Y Z``, or ``start``
to die at once."""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import Any

import numpy as np

from graspdb_simworker.process import child
from graspdb_simworker.simulation import chunks


def main() -> int:
    how = sys.argv[1]
    if how == "start":
        return 3
    deadly = np.array([float(v) for v in sys.argv[2:5]])
    simulate = chunks.Workpiece.simulate

    def faulty(self: chunks.Workpiece, position: Any, quaternion: Any, travel_m: float, draw: int) -> Any:
        if np.allclose(position, deadly, atol=1e-12):
            if how == "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            elif how == "hang":
                # As a hanging C call does: no handler of Python's gets a turn.
                signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
                time.sleep(600.0)
            elif how == "spin":
                began = time.process_time()
                while time.process_time() < began + 600.0:
                    pass
            raise RuntimeError("the parts make no sense")
        return simulate(self, position, quaternion, travel_m, draw)

    chunks.Workpiece.simulate = faulty  # type: ignore[method-assign]
    return child.main()


if __name__ == "__main__":
    sys.exit(main())
