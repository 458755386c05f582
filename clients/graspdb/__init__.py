"""GraspDB: the Python SDK of the grasp database that answers.

``from graspdb import Client`` is all most programs need; see :class:`graspdb.client.Client`.
Attributes load on first use, so that the service and the worker, which share only
:mod:`graspdb.wire` and :mod:`graspdb.transport`, do not import the rest.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from graspdb.asynchronous import AsyncClient as AsyncClient
    from graspdb.client import Client as Client
    from graspdb.errors import GraspDBError as GraspDBError
    from graspdb.errors import Infeasible as Infeasible

__version__ = "0.1.0"

_HOMES = {
    "AsyncClient": "graspdb.asynchronous",
    "Client": "graspdb.client",
    "GraspDBError": "graspdb.errors",
    "Infeasible": "graspdb.errors",
}

__all__ = ["AsyncClient", "Client", "GraspDBError", "Infeasible", "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'graspdb' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
