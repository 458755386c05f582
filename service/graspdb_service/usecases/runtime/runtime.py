"""What every use case runs on."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.usecases.runtime.compute import Compute


@dataclass(kw_only=True)
class Runtime:
    """Settings, database and threads of one service process; ``mesh_children`` bounds those at a time."""

    settings: Settings
    database: Database
    compute: Compute
    mesh_children: threading.BoundedSemaphore = field(default_factory=lambda: threading.BoundedSemaphore(2))
