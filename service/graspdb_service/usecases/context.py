"""What every use case works with."""

from __future__ import annotations

from dataclasses import dataclass

from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database


@dataclass
class Context:
    """The parts of one service process."""

    settings: Settings
    database: Database

    @classmethod
    def create(cls, settings: Settings, database: Database) -> Context:
        return cls(settings=settings, database=database)

    def close(self) -> None:
        self.database.dispose()
