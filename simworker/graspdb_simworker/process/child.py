"""The process that simulates: reads chunks from its standard input, answers on its standard output.

Run as ``python -m graspdb_simworker.process.child`` by :mod:`graspdb_simworker.process.local`. The engine
lives here, because pybullet can crash or hang a whole process on one unlucky pose, and leaks. A pose that
takes too long ends the process by an alarm of the kernel's, which works even while an engine holds the
interpreter's lock.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from graspdb_simworker.process import channel
from graspdb_simworker.simulation.engines import installed


def main() -> int:
    """Serve chunks until the standard input ends."""
    source, sink = channel.take_streams()
    complaints = os.dup(2)
    os.dup2(0, 2)  # pybullet greets on the standard error
    try:
        from graspdb_simworker.process import serving  # extra: sim

        installed.world_of(installed.require(None))
    except (ImportError, installed.EngineMissing) as error:
        channel.send(sink, channel.MISSING, str(error).encode())
        return 2
    finally:
        os.dup2(complaints, 2)
    with suppress(channel.Closed):
        serving.serve(source, sink)
    return 0


if __name__ == "__main__":
    sys.exit(main())
