"""A disk that fills up and gets room again, and a guard that clears it away however a test ends."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

#: Big enough for a PostgreSQL with its log, small enough to be filled in the memory of any machine.
SIZE_MB = 384
_GUARD = """
read -r _
all() {
  for process in /proc/[0-9]*; do
    case "$(readlink "$process/cwd")" in "$1" | "$1"/*) echo "${process#/proc/}" ;; esac
  done
}
for signal in CONT QUIT; do
  for process in $(all "$1"); do kill -$signal "$process"; done
done
for again in 1 2 3 4 5 6 7 8 9 10; do
  [ -n "$(all "$1")" ] || break
  sleep 0.1
done
while [ -n "$(all "$1")" ]; do
  for process in $(all "$1"); do kill -KILL "$process"; done
  sleep 0.1
done
# What libfaketime leaves of processes that were killed.
while read -r process; do
  rm -f "/dev/shm/faketime_shm_$process" "/dev/shm/sem.faketime_sem_$process"
done <"$1/pids"
umount -l "$1/disk"
rm -rf "$1"
"""


class Guard:
    """Ends whatever still works in ``folder``, paused or not, and removes it: at :meth:`close`, and also when
    the test's own process is killed.
    """

    def __init__(self, folder: Path) -> None:
        self._shell = subprocess.Popen(
            ["sh", "-c", _GUARD, "guard", str(folder)],
            cwd="/",
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def close(self) -> None:
        self._shell.communicate(timeout=60)


class SmallDisk:
    """The folder ``disk`` below ``folder``: in memory of its own where mounting is allowed.

    Elsewhere a full disk is made of the limit on the size of files of the processes that write to it: no file
    of theirs grows any more.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "disk"
        self.folder.mkdir()
        options = f"size={SIZE_MB}m,mode=755"
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(self.folder)]
        allowed = os.geteuid() == 0 and shutil.which("mount") is not None
        self.is_mounted = (
            allowed and subprocess.run(command, capture_output=True, check=False).returncode == 0
        )
        self._ballast = self.folder / "ballast"

    def fill(self, writers: Iterable[int]) -> None:
        """Leave no room; ``writers`` are the processes that write here."""
        if self.is_mounted:
            # Without a buffer: what one holds when no room is left would be written, and fail, at closing.
            with suppress(OSError), self._ballast.open("wb", buffering=0) as ballast:
                while ballast.write(b"\0" * 2**20):
                    pass
            return
        for pid in writers:
            self._limit(pid, "4096")

    def free(self, writers: Iterable[int]) -> None:
        """Make room again."""
        self._ballast.unlink(missing_ok=True)
        if not self.is_mounted:
            for pid in writers:
                self._limit(pid, "unlimited")

    def _limit(self, pid: int, size: str) -> None:
        """Bound the files of a process, as its own user: another needs a right that few containers give."""
        with suppress(FileNotFoundError):
            owner = Path(f"/proc/{pid}").stat().st_uid
            command = ["prlimit", f"--pid={pid}", f"--fsize={size}:"]
            as_owner = owner if os.geteuid() == 0 else None
            subprocess.run(command, user=as_owner, cwd="/", capture_output=True, check=False)
