"""The clock of one process, set forward and back while it runs."""

from __future__ import annotations

import os
from pathlib import Path

_PLACES = ("usr/lib/*/faketime/libfaketime.so.1", "usr/lib/faketime/libfaketime.so.1")


class JumpingClock:
    """A clock that runs ``hours`` ahead of the machine's, for processes started with ``environment``.

    By libfaketime where it is installed (Debian's package faketime), which changes what a whole process is
    told of the time of day; elsewhere by replacing what its Python code and SQLite read. How long something
    takes is measured as ever, as when somebody sets a machine's clock.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self.set(0.0)

    def set(self, hours: float) -> None:
        new = self._file.with_suffix(".new")
        new.write_text(f"{hours * 3600.0:+.0f}\n")
        new.replace(self._file)

    @property
    def environment(self) -> dict[str, str]:
        path = [str(Path(__file__).with_name("faked_time")), os.environ.get("PYTHONPATH")]
        found = {
            "FAKETIME_TIMESTAMP_FILE": str(self._file),
            "PYTHONPATH": os.pathsep.join(filter(None, path)),
        }
        libraries = sorted(str(library) for place in _PLACES for library in Path("/").glob(place))
        if libraries:
            found |= {
                "LD_PRELOAD": libraries[0],
                "FAKETIME_NO_CACHE": "1",
                "FAKETIME_DONT_FAKE_MONOTONIC": "1",
                # Else waits with an end are cut short, and the interpreter's threads only take turns.
                "FAKETIME_FORCE_MONOTONIC_FIX": "0",
            }
        return found
