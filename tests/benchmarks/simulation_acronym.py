"""How often simulated labels agree with ACRONYM's: a sample of the grasps of each file, by every protocol.

``python tests/benchmarks/simulation_acronym.py FOLDER [--grasps 400] [--protocols wrench lift shake]
[--force-n 70] [--seed 0] [--randomise '{"draws": 10}']``

FOLDER holds ACRONYM's .h5 files and, anywhere below it, their meshes by the names that the files give. The
gripper is the Panda, mass and friction are the files'; with what force ACRONYM's closes they do not say, and
``--force-n`` may name others than the Panda's. With several forces or protocols, what is not told is chosen
for each file by one half of its grasps and judged by the other, and the other way round: the row
``chosen by the other half``. Rows of all files together come last. Agreement has to be read beside the share
of the majority class, which who always says the same reaches; balanced accuracy is the mean of the shares of
both classes that are labelled right. With ``--randomise`` every grasp is simulated under what that draws (an
object as in a sweep's request; what it leaves out is drawn as usual there), and holds if at least half of its
draws do. What k of n tells beside that is the share of pairs in order: of a grasp that held in ACRONYM and
one that did not, how often the first succeeds more often here; equally often counts half. Data sets are no
part of this project: without a folder nothing is done.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from itertools import product
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


class Compared(NamedTuple):
    """Labels (n,) of a protocol and a force beside ACRONYM's; ``usual`` is the majority class of its file."""

    outcomes: NDArray[np.uint8]
    successes: NDArray[np.uint8]
    held: NDArray[np.bool_]
    usual: NDArray[np.bool_]

    @property
    def agree(self) -> NDArray[np.bool_]:
        """Which labels (n,) are ACRONYM's, too."""
        return np.asarray((self.outcomes == Outcome.SUCCESS) == self.held)

    @classmethod
    def joined(cls, parts: list[Compared]) -> Compared:
        """Those of several files or halves as one."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def of(self, rows: NDArray[np.intp]) -> Compared:
        """Some of the n."""
        return Compared(*(column[rows] for column in self))


def told(name: str, how: str, compared: Compared, seconds: float | None = None) -> None:
    """Print a row, and what the labels were that do not agree."""
    held, agree = compared.held, compared.agree
    balanced = 0.5 * (np.mean(agree[held]) + np.mean(agree[~held]))
    majority = np.mean(compared.usual == held)
    wrong = Counter(Outcome(int(code)).name.lower() for code in compared.outcomes[~agree])
    words = ", ".join(
        f"{number} held, ACRONYM's failed" if label == "success" else f"{number} {label}, ACRONYM's held"
        for label, number in wrong.most_common()
    )
    print(
        f"| {name} | {how} | {len(held)} | {np.mean(agree):.3f} | {majority:.3f}"
        f" | {np.mean(agree) - majority:+.3f} | {balanced:.3f} | {ranked(compared.successes, held):.3f}"
        f" | {words} | {'' if seconds is None else f'{seconds:.0f}'} |",
        flush=True,
    )


def chosen_by_the_other_half(ways: dict[str, Compared]) -> Compared:
    """What agrees best with one half of the grasps, on the other half; and the other way round."""
    count = len(next(iter(ways.values())).held)
    halves = np.arange(0, count, 2), np.arange(1, count, 2)
    judged = []
    for learn, judge in (halves, halves[::-1]):
        best = max(ways.values(), key=lambda way: float(way.agree[learn].mean()))
        judged.append(best.of(judge))
    return Compared.joined(judged)


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    asked.add_argument("folder", nargs="?", type=Path)
    asked.add_argument("--grasps", type=int, default=400)
    asked.add_argument("--protocols", nargs="*", default=chunks.PROTOCOLS)
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--force-n", type=float, nargs="*", default=[PANDA.force_n])
    asked.add_argument("--randomise", type=Randomise.model_validate_json)
    given = asked.parse_args()
    if given.folder is None:
        print("nothing done: give a folder with ACRONYM's files and their meshes")
        return
    heads = (
        "object",
        "protocol, closing force",
        "grasps",
        "agreement",
        "majority class",
        "over it",
        "balanced accuracy",
        "pairs in order",
        "disagreements",
        "s",
    )
    print("|", " | ".join(heads), "|")
    print("|---" * len(heads) + "|")
    of_files: dict[str, list[Compared]] = {}
    for path in sorted(given.folder.rglob("*.h5")):
        file = read(path, given.folder, given.grasps, given.seed)
        ways: dict[str, Compared] = {}
        usual = np.full_like(file.held, file.held.mean() >= 0.5)
        for protocol, force in product(given.protocols, given.force_n):
            started = time.process_time()
            gripper = PANDA.model_copy(update={"force_n": force})
            found = simulated(file, protocol, gripper, given.randomise)
            way = f"`{protocol}`, {force:g} N"
            ways[way] = Compared(found.outcome, found.successes, file.held, usual)
            told(f"{file.name}, {len(file.parts)} parts", way, ways[way], time.process_time() - started)
        if len(ways) > 1:
            ways["chosen by the other half"] = chosen_by_the_other_half(ways)
            told(file.name, "chosen by the other half", ways["chosen by the other half"])
        for way, compared in ways.items():
            of_files.setdefault(way, []).append(compared)
    for way, files in of_files.items():
        told("all", way, Compared.joined(files))


if __name__ == "__main__":
    main()
