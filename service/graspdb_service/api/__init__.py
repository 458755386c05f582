"""The HTTP contract: one router a noun; thin, for the use cases do the work."""

from graspdb import wire
from graspdb_service.api.routing.document import describe

describe(wire.Request, wire.Response)
