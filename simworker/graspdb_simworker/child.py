"""The process that simulates: reads chunks from its standard input, answers on its standard output.

Run as ``python -m graspdb_simworker.child`` by :mod:`graspdb_simworker.supervisor`. pybullet lives
here, because it can crash or hang a whole process on one unlucky pose, and leaks. A pose that takes too
long ends the process by an alarm of the kernel's, which works even while pybullet holds the
interpreter's lock, and even if the worker is long dead.
"""

from __future__ import annotations

import os
import signal
import sys

from graspdb_simworker import messages


def main() -> int:
    """Serve chunks until the standard input ends."""
    source = os.dup(0)
    sink = os.dup(1)
    # pybullet and Bullet print on the standard output: out of the way of the messages.
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 0)
    os.dup2(null, 1)
    # An interrupt at the terminal, or a manager that stops the whole group, is for the worker, who ends its
    # children itself: one that died before it would look like the work's fault.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    complaints = os.dup(2)
    os.dup2(null, 2)  # pybullet greets on the standard error
    try:
        from graspdb_simworker import serving
    except ImportError as error:
        messages.send(sink, messages.MISSING, str(error).encode())
        return 2
    finally:
        os.dup2(complaints, 2)
    try:
        serving.serve(source, sink)
    except messages.Closed:
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
