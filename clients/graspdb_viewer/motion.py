"""The motion of a simulated trial: its worker's states, which the same simulation gives again."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspdb.poses import Poses
from graspdb.processes import ChildProcess
from graspdb.wire import SweepInfo, TrialOut

_WORKER = "graspdb-simworker"
_PATIENCE_S = 120.0
_ALIKE_M = 1e-7
"""Rows of sweeps have widths to this."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What a jaw and an object did, at ``times_s`` (n,) from when the fingers start wide open.

    ``fingers_m`` (n, 2) is how far the finger at +y and that at -y are from the middle; ``poses`` (n,) are
    of the object frame in the tool frame, which stands still.
    """

    outcome: str
    width_m: float | None
    times_s: NDArray[np.float64]
    fingers_m: NDArray[np.float64]
    poses: Poses

    def slowed(self, lasts_s: float) -> tuple[Motion, float]:
        """The same, lasting so long at least from just before the first touch on; how much slower that is."""
        touch = float(self.times_s[1])
        slower = max(1.0, lasts_s / max(float(self.times_s[-1]) - touch, 1e-3))
        after = np.maximum(self.times_s - touch, 0.0)
        return replace(self, times_s=np.minimum(self.times_s, touch) + slower * after), slower

    def is_of(self, trial: TrialOut) -> bool:
        """Whether it came out as the trial did: the same outcome, the fingers as far apart."""
        if self.outcome != trial.outcome:
            return False
        if self.width_m is None or trial.width_m is None:
            return self.width_m is None and trial.width_m is None
        return abs(self.width_m - trial.width_m) < _ALIKE_M


def simulated(trial: TrialOut, sweep: SweepInfo, url: str, api_key: str | None) -> Motion:
    """Simulate a trial of a sweep again, as the sweep did, in a process of its own.

    With the object's mass, friction and parts as they are today. ValueError where it can't be: no worker is
    installed here, or it says why.
    """
    command = Path(sys.executable).with_name(_WORKER)
    found = str(command) if command.exists() else shutil.which(_WORKER)
    if found is None:
        raise ValueError("A replay is simulated here: it needs pip install 'graspdb[sim]' beside the viewer.")
    version = "" if sweep.gripper_version is None else f"@{sweep.gripper_version}"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "motion.json"
        arguments = {
            "position": ",".join(map(repr, trial.position)),
            "quaternion": ",".join(map(repr, trial.quaternion_xyzw)),
            "gripper": f"{sweep.gripper}{version}",
            "protocol": sweep.protocol,
            "url": url,
            "out": str(out),
        }
        given = [f"--{name}={value}" for name, value in arguments.items()]
        fine = ["--fine"] if sweep.fidelity == "fine" else []
        # Of several it may have been any.
        if sweep.sole_engine is not None:
            given.append(f"--engine={sweep.sole_engine}")
        key = {} if api_key is None else {"GRASPDB_API_KEY": api_key}
        process = ChildProcess(
            [found, "show", sweep.object, *given, *fine],
            env={**os.environ, **key},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        try:
            _, told = process.communicate(timeout=_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise ValueError("The simulation took too long.") from None
        if process.returncode:
            lines = told.decode(errors="replace").strip().splitlines()
            raise ValueError(lines[-1] if lines else "The simulation failed.")
        document = json.loads(out.read_text(encoding="utf-8"))
    return Motion(
        document["outcome"],
        document["width_m"],
        np.array(document["times_s"]),
        np.array(document["fingers_m"]),
        Poses(np.array(document["position"]), np.array(document["quaternion_xyzw"])),
    )
