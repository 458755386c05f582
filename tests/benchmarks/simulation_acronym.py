"""How often simulated labels agree with ACRONYM's: a sample of the grasps of each file, by every protocol.

``python tests/benchmarks/simulation_acronym.py FOLDER [--grasps 400] [--protocols wrench lift shake]
[--force-n 70] [--seed 0] [--randomise '{"draws": 10}']``

FOLDER holds ACRONYM's .h5 files and, anywhere below it, their meshes by the names that the files give. The
gripper is the Panda, mass and friction are the files'; with what force ACRONYM's closes they do not say, and
``--force-n`` may be another than the Panda's. Agreement has to be read beside the share of the majority
class, which who always says the same reaches; balanced accuracy is the mean of the shares of both classes
that are labelled right. With ``--randomise`` every grasp is simulated under what that draws (an object as
in a sweep's request; what it leaves out is drawn as usual there), and holds if at least half of its draws do.
What k of n tells beside that is the share of pairs in order: of a grasp that held in ACRONYM and one that did
not, how often the first succeeds more often here; equally often counts half. Data sets are no part of this
project: without a folder nothing is done.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from graspdb import interop
from graspdb.wire import DecomposePayload, GripperProfile, SimulatePayload
from graspdb.wire.presets.grippers import PRESETS
from graspdb.wire.sweeps import Randomise
from graspdb_geometry import meshes
from graspdb_simworker.decomposition import supervisor
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.bodies import Part
from graspdb_simworker.simulation.labels import Outcome

PANDA = PRESETS["panda"].profile
LIMITS = supervisor.ResourceLimits(seconds=120.0)


class Labelled(NamedTuple):
    """A file's object, and a sample of its grasps: tool poses (n, 3), (n, 4), and which of them held (n,)."""

    name: str
    parts: list[Part]
    mass_kg: float
    friction: float
    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    held: NDArray[np.bool_]


def read(path: Path, folder: Path, count: int, seed: int) -> Labelled:
    """A file with its mesh, cut into convex parts; ``count`` of its grasps, the same ones for a seed."""
    with h5py.File(path, "r") as file:
        about: dict[str, Any] = {name: file[f"object/{name}"][()] for name in file["object"]}
    mesh = next(folder.rglob(Path(about["file"].decode()).name))
    order = DecomposePayload(
        object="acronym",
        mesh="",
        mesh_sha256="",
        media_type=f"model/{mesh.suffix[1:].lower()}",
        scale=float(about["scale"]),
    )
    parts = meshes.parts_from_glb(supervisor.decompose(order, mesh.read_bytes(), limits=LIMITS))
    grasps = interop.read(path, gripper=PANDA)
    some = np.sort(np.random.default_rng(seed).permutation(len(grasps))[:count])
    return Labelled(
        path.stem.split("_")[0],
        list(parts),
        float(about["mass"]),
        float(about["friction"]),
        grasps.position[some],
        grasps.quaternion_xyzw[some],
        grasps.outcomes[some] == "success",
    )


def simulated(
    file: Labelled, protocol: str, gripper: GripperProfile, randomise: Randomise | None
) -> chunks.Simulated:
    """What becomes of the grasps."""
    payload = SimulatePayload.model_validate(
        {
            "sweep": "benchmark",
            "object": "acronym",
            "convex_parts": "",
            "parts_sha256": "",
            "mass_kg": file.mass_kg,
            "friction": file.friction,
            "gripper": gripper,
            "protocol": protocol,
            "fidelity": "standard",
            "randomise": randomise,
            "start": 0,
            "stop": len(file.held),
        }
    )
    workpiece = chunks.prepare(payload, file.parts)
    indices = np.arange(payload.stop)
    found = chunks.simulate_poses(payload, workpiece, indices, file.positions, file.quaternions)
    workpiece.close()
    return found


def ranked(successes: NDArray[np.uint8], held: NDArray[np.bool_]) -> float:
    """Share of pairs, one that held and one that did not, that successes (n,) put in this order."""
    more = successes[held][:, None].astype(int) - successes[~held]
    return float(np.mean(more > 0) + 0.5 * np.mean(more == 0))


def measure(file: Labelled, protocol: str, gripper: GripperProfile, randomise: Randomise | None) -> None:
    """Print a file's row, and what the labels were that do not agree."""
    started = time.process_time()
    found = simulated(file, protocol, gripper, randomise)
    outcomes = found.outcome
    ours, theirs = outcomes == Outcome.SUCCESS, file.held
    balanced = 0.5 * (np.mean(ours[theirs]) + np.mean(~ours[~theirs]))
    majority = max(np.mean(theirs), np.mean(~theirs))
    wrong = Counter(Outcome(int(code)).name.lower() for code in outcomes[ours != theirs])
    told = ", ".join(
        f"{number} held, ACRONYM's failed" if name == "success" else f"{number} {name}, ACRONYM's held"
        for name, number in wrong.most_common()
    )
    pairs = ranked(found.successes, theirs)
    print(
        f"| {file.name} | {len(file.parts)} | {protocol} | {len(ours)} | {np.mean(ours == theirs):.3f}"
        f" | {majority:.3f} | {balanced:.3f} | {pairs:.3f} | {told} | {time.process_time() - started:.0f} |",
        flush=True,
    )


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    asked.add_argument("folder", nargs="?", type=Path)
    asked.add_argument("--grasps", type=int, default=400)
    asked.add_argument("--protocols", nargs="*", default=chunks.PROTOCOLS)
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--force-n", type=float, default=PANDA.force_n)
    asked.add_argument("--randomise", type=Randomise.model_validate_json)
    given = asked.parse_args()
    gripper = PANDA.model_copy(update={"force_n": given.force_n})
    if given.folder is None:
        print("nothing done: give a folder with ACRONYM's files and their meshes")
        return
    heads = (
        "parts",
        "protocol",
        "grasps",
        "agreement",
        "majority class",
        "balanced accuracy",
        "pairs in order",
        "disagreements",
    )
    print("| object |", " | ".join(heads), "| s |")
    print("|---" * 10 + "|")
    for path in sorted(given.folder.rglob("*.h5")):
        file = read(path, given.folder, given.grasps, given.seed)
        for protocol in given.protocols:
            measure(file, protocol, gripper, given.randomise)


if __name__ == "__main__":
    main()
