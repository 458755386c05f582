"""Which engines there are here, and the worlds that they build."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
from collections.abc import Sequence
from typing import get_args

from graspdb.wire.sweeps import Engine
from graspdb_simworker.simulation.engines.world import EngineWorld

ENGINES: tuple[Engine, ...] = get_args(Engine)
"""All engines, that first which is the default where it is."""


class EngineMissing(Exception):
    """There is no engine here, or not the one asked for; the message says what to install."""


def names() -> Sequence[Engine]:
    """The engines that are installed, the default first."""
    return [engine for engine in ENGINES if importlib.util.find_spec(engine) is not None]


def require(engine: Engine | None) -> Engine:
    """The engine asked for, or the default one. EngineMissing where it is not installed."""
    there = names()
    here = f"this is CPython {platform.python_version()} on {platform.machine()} {platform.system()}"
    if engine is not None and engine not in there:
        extra = {
            "pybullet": "sim]'`, with wheels for CPython 3.10 and 3.11 on x86-64 Linux",
            "mujoco": "sim,mujoco]'`",
        }
        raise EngineMissing(f"{engine} is not installed: `pip install 'graspdb[{extra[engine]} ({here})")
    if not there:
        raise EngineMissing(
            "no physics engine is installed: the extra `pip install 'graspdb[sim]'` brings pybullet where it"
            " has wheels (CPython 3.10 and 3.11 on x86-64 Linux), `pip install 'graspdb[sim,mujoco]'` MuJoCo"
            f" ({here})"
        )
    return engine or there[0]


def version_of(engine: Engine) -> str:
    """The version of an engine that is installed."""
    return importlib.metadata.version(engine)


def world_of(engine: Engine) -> type[EngineWorld]:
    """What builds the worlds of an engine that is installed."""
    if engine == "mujoco":
        # Nothing is drawn with it: no library of graphics is looked for.
        os.environ.setdefault("MUJOCO_GL", "disable")
        from graspdb_simworker.simulation.engines.mujoco_world import MujocoWorld  # extra: mujoco

        return MujocoWorld
    from graspdb_simworker.simulation.engines.bullet_world import BulletWorld  # extra: sim

    return BulletWorld
