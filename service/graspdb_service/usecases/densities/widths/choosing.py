"""Widths chosen once for the same rows, whichever replica needs them, and kept when it is restarted."""

from __future__ import annotations

import hashlib
import logging
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np

from graspdb_density import choose_widths
from graspdb_density.kde.rows import Rows
from graspdb_service import __version__
from graspdb_service.storage.database import UNAVAILABLE, CommitUnknown, Database
from graspdb_service.storage.derived import width_choices
from graspdb_service.storage.derived.width_choices import ChosenWidths

log = logging.getLogger("graspdb")


class WidthChoosing:
    """The widths of one service process's densities, over a database that others may share.

    Choosing them takes nearly all of the time of building a density. They follow from the rows alone, so what
    any replica has chosen from the same rows is taken: it is known by their SHA-256. Who asks never waits for
    a writer: a thread keeps the choice, and one that can't be kept is made again by whoever needs it.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._writer = ThreadPoolExecutor(1, "graspdb-widths")

    def choose(self, object_id: int, rows: Rows, *, threads: int) -> ChosenWidths:
        """The widths that all of these rows of an object choose."""
        digest = _digest(rows)
        with suppress(*UNAVAILABLE), self._database.read() as tx:
            known = width_choices.find(tx, object_id, digest)
            if known is not None:
                return known
        choice = choose_widths(rows, threads=threads)
        found = ChosenWidths(choice.kernel.sigma_position_m, choice.kernel.sigma_rotation, choice.rule)
        # Not to be had any more when the service is about to stop.
        with suppress(RuntimeError):
            self._writer.submit(self._keep, object_id, digest, found)
        return found

    def close(self) -> None:
        """Keep what was chosen, and stop."""
        self._writer.shutdown()

    def _keep(self, object_id: int, digest: str, found: ChosenWidths) -> None:
        try:
            with self._database.write() as tx:
                width_choices.add(tx, object_id, digest, found)
        except (*UNAVAILABLE, CommitUnknown) as error:
            log.debug("chosen widths can't be kept now: %s", error)
        except Exception:
            log.exception("chosen widths could not be kept")


def _digest(rows: Rows) -> str:
    """Of all that a choice follows from, the version that chooses included."""
    sha = hashlib.sha256(__version__.encode())
    for each in (*rows.poses, rows.weights, rows.symmetric):
        sha.update(np.ascontiguousarray(each).tobytes())
    return sha.hexdigest()
