"""Best grasps with the collision test, on the mug as it comes and on one of 100,000 triangles; and what the
first question about that one, which reads it and builds its tree, costs questions that are warm.

Trials are `edges` proposals, all of them called successes: the search has to look for those that are free.
"""

from __future__ import annotations

import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import trimesh
from service_queries import server, timed, told

from graspdb import Client

TRIALS, ASKED = 2_000, 60


def dense_mug(triangles: int) -> trimesh.Trimesh:
    """A mug of 80 by 90 mm with a torus for a handle and walls of 4 mm, of at least so many triangles."""
    wall = trimesh.creation.annulus(r_min=0.036, r_max=0.04, height=0.09, sections=96)
    floor = trimesh.creation.cylinder(radius=0.038, height=0.005, sections=96)
    floor.apply_translation([0, 0, -0.0425])
    ring = trimesh.creation.torus(0.025, 0.005, 64, 32)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring.apply_translation([0.045, 0, 0])
    room = trimesh.creation.cylinder(radius=0.036, height=0.2, sections=96)
    room.apply_translation([0, 0, 0.06])
    ring = trimesh.boolean.difference([ring, room], engine="manifold")
    mug = trimesh.boolean.union([wall, floor, ring], engine="manifold")
    size = 0.01
    while len(mug.faces) < triangles:
        size *= 0.8
        mug = mug.subdivide_to_size(size)
    return mug


def tried(http: httpx.Client, slug: str, drawn_of: str) -> None:
    drawn = http.post(
        f"/objects/{drawn_of}/proposals",
        json={"count": TRIALS, "strategy": "edges", "gripper": "panda", "seed": 0},
    )
    columns = {key: drawn.raise_for_status().json()[key] for key in ("position", "quaternion_xyzw")}
    columns["outcome"] = ["success"] * TRIALS
    http.post(f"/objects/{slug}/trials", json={"columns": columns, "gripper": "panda"}).raise_for_status()


def asked(rng: np.random.Generator) -> dict[str, Any]:
    lower = rng.uniform(-0.1, -0.05, 3)
    return {"box_min": ",".join(f"{x:.6f}" for x in lower), "box_max": "0.2,0.2,0.2", "collision_free": True}


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder, server(Path(folder)) as url:
        with Client(url) as db:
            db.add_example("mug")
        http, other = (httpx.Client(base_url=url, timeout=300) for _ in range(2))

        def best(slug: str, client: httpx.Client) -> float:
            return timed(lambda: client.get(f"/objects/{slug}/best-grasp", params=asked(rng)))

        tried(http, "mug", "mug")
        told("mug: first best grasp", [best("mug", http)])
        told("mug: best grasp", [best("mug", http) for _ in range(ASKED)])
        for slug, least in (("coarse", 0), ("dense", 100_000)):
            mesh = dense_mug(least)
            http.post("/objects", json={"id": slug}).raise_for_status()
            stl = {"Content-Type": "model/stl"}
            content = mesh.export(file_type="stl")
            stored = timed(partial(http.put, f"/objects/{slug}/mesh", content=content, headers=stl))
            print(f"{len(mesh.faces):,} triangles stored in {stored / 1000:.1f} s")
        cold: list[float] = []
        pose = {"position": "0,0,0.1", "quaternion_xyzw": "1,0,0,0", "gripper": "panda"}
        first = threading.Thread(
            target=lambda: cold.append(timed(lambda: other.get("/objects/dense/likelihood", params=pose)))
        )
        first.start()
        meanwhile = []
        while first.is_alive():
            meanwhile.append(best("mug", http))
            time.sleep(0.02)
        told("dense: first question (reads, builds its tree)", cold)
        if meanwhile:
            told("  mug: best grasp meanwhile", meanwhile, f"max {max(meanwhile):.0f} ms")
        # Edges of so many triangles take long to find; those of the same mug with fewer are the same.
        tried(http, "dense", "coarse")
        told("dense: first best grasp", [best("dense", http)])
        told("dense: best grasp", [best("dense", http) for _ in range(ASKED)])


if __name__ == "__main__":
    main()
