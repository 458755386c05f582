"""Small files as other projects write them, made of poses of the frame that their format wants."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

#: What turns axes of our convention into those of others, on the right: z/y to z/x, and to x/y.
TO_ZX = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TO_XY = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def turned(poses: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) with other axes at the same origin."""
    out = poses.copy()
    out[:, :3, :3] = poses[:, :3, :3] @ rotation
    return out


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """A unit quaternion xyzw of one rotation (3, 3), by its axis and angle."""
    cosine = np.clip((np.trace(rotation) - 1) / 2, -1, 1)
    # The eigenvector of 1; its sign by the antisymmetric part.
    values, vectors = np.linalg.eig(rotation)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    axis /= np.linalg.norm(axis)
    skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = axis @ skew / 2
    angle = np.arctan2(sine, cosine)
    return np.append(axis * np.sin(angle / 2), np.cos(angle / 2))


def acronym_h5(path: Path, poses: np.ndarray, held: Sequence[int], scale: float = 0.5, **more: Any) -> str:
    """As ACRONYM: ``poses`` of the base, z approaches and x closes."""
    with h5py.File(path, "w") as file:
        file["grasps/transforms"] = poses
        flex = "grasps/qualities/flex"
        file[f"{flex}/object_in_gripper"] = np.asarray(held, dtype=np.int64)
        for what in ("closing", "shaking"):
            for how in ("linear", "angular"):
                file[f"{flex}/object_motion_during_{what}_{how}"] = np.linspace(0, 1, len(poses))
        file["gripper/type"] = "panda"
        file["gripper/configuration"] = np.array([0.04])
        file["object/file"] = "meshes/Mug/mug.obj"
        file["object/scale"] = scale
        for name, value in {"mass": 0.1, "density": 150.0, "friction": 1.0, **more}.items():
            file[f"object/{name}"] = value
    return str(path)


def acronym_json(path: Path, poses: np.ndarray, held: Sequence[int]) -> str:
    """ACRONYM's other form."""
    return written(
        path,
        {
            "object": "meshes/Mug/mug.obj",
            "object_scale": 0.5,
            "transforms": poses.tolist(),
            "quality_flex_object_in_gripper": [int(x) for x in held],
            "quality_flex_object_motion_during_closing_linear": [0.25] * len(poses),
        },
    )


def graspgen(path: Path, poses: np.ndarray, held: Sequence[int]) -> str:
    """As GraspGen reads its training data."""
    grasps = {"transforms": poses.tolist(), "object_in_gripper": [bool(x) for x in held]}
    return written(path, {"object": {"file": "mug.obj", "scale": 0.5}, "grasps": grasps})


def isaac(path: Path, poses: np.ndarray, confidence: Sequence[float], **header: Any) -> str:
    """isaac_grasp 1.0; ``header`` replaces and adds keys at the top."""
    grasps = {}
    for number, (pose, score) in enumerate(zip(poses, confidence, strict=True)):
        x, y, z, w = quaternion(pose[:3, :3]).tolist()
        grasps[f"grasp_{number}"] = {
            "confidence": float(score),
            "position": pose[:3, 3].tolist(),
            "orientation": {"w": w, "xyz": [x, y, z]},
            "cspace_position": {"panda_finger_joint1": 0.01},
            "pregrasp_cspace_position": {"panda_finger_joint1": 0.04},
        }
    data = {"format": "isaac_grasp", "format_version": 1.0, **header, "grasps": grasps}
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return str(path)


def graspnet_rows(poses: np.ndarray, scores: Sequence[float], depth: float, object_id: int = 5) -> np.ndarray:
    """(N, 17): poses of the anchor, x approaches and y closes."""
    rows = np.zeros((len(poses), 17))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = scores, 0.06, 0.02, depth
    rows[:, 4:13] = poses[:, :3, :3].reshape(-1, 9)
    rows[:, 13:16], rows[:, 16] = poses[:, :3, 3], object_id
    return rows


def vgn(path: Path, poses: np.ndarray, labels: Sequence[int], scenes: Sequence[str]) -> str:
    """VGN's grasps.csv."""
    lines = ["scene_id,qx,qy,qz,qw,x,y,z,width,label"]
    for pose, label, scene in zip(poses, labels, scenes, strict=True):
        numbers = [*quaternion(pose[:3, :3]), *pose[:3, 3], 0.05]
        lines.append(",".join([scene, *(repr(float(x)) for x in numbers), str(label)]))
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def multigripper(path: Path, poses: np.ndarray, result: Sequence[int], gripper: str = "fetch_gripper") -> str:
    """MultiGripperGrasp after its simulation: w first."""
    rows = [[*p[:3, 3].tolist(), *quaternion(p[:3, :3])[[3, 0, 1, 2]].tolist()] for p in poses]
    return written(
        path,
        {
            "gripper": gripper,
            "object_ID": "Mug",
            "pose": rows,
            "dofs": [[0.05, 0.05]] * len(rows),
            "final_dofs": [[0.02, 0.02]] * len(rows),
            "result": [int(x) for x in result],
            "result_time": [1.5] * len(rows),
            "runtime": 3.0,
        },
    )


def moveit(path: Path, poses: np.ndarray, quality: Sequence[float], frame_id: str = "") -> str:
    """A list of moveit_msgs/Grasp, YAML or JSON by the name's end."""
    grasps = []
    for number, (pose, score) in enumerate(zip(poses, quality, strict=True)):
        grasps.append(
            {
                "id": f"g{number}",
                "pre_grasp_posture": {"joint_names": ["finger"], "points": []},
                "grasp_pose": {
                    "header": {"seq": 0, "frame_id": frame_id},
                    "pose": {
                        "position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
                        "orientation": dict(zip("xyzw", quaternion(pose[:3, :3]).tolist(), strict=True)),
                    },
                },
                "grasp_quality": float(score),
                "max_contact_force": 0.0,
            }
        )
    if path.suffix == ".json":
        return written(path, grasps)
    path.write_text(yaml.safe_dump(grasps))
    return str(path)


def graspit_world(path: Path, body: np.ndarray, robot: np.ndarray) -> str:
    """A world with one body and one robot, poses (4, 4) in metres."""

    def transform(pose: np.ndarray) -> str:
        x, y, z, w = quaternion(pose[:3, :3])
        at = " ".join(f"{1000 * value:+.12g}" for value in pose[:3, 3])
        full = f"({w:+.15g} {x:+.15g} {y:+.15g} {z:+.15g})[{at}]"
        return f"<transform><fullTransform>{full}</fullTransform></transform>"

    path.write_text(
        '<?xml version="1.0" ?>\n<world>\n'
        f"<graspableBody><filename>models/objects/mug.xml</filename>{transform(body)}</graspableBody>\n"
        f"<robot><filename>models/robots/pr2.xml</filename><dofValues>0.5</dofValues>{transform(robot)}</robot>\n"
        "</world>\n"
    )
    return str(path)


def uibk(path: Path, poses: np.ndarray, outcomes: Sequence[str], unit: float = 1000.0) -> str:
    """RobWork's experiments: each outcome is a quality of success or a cause of failure."""
    grasps = []
    for pose, outcome in zip(poses, outcomes, strict=True):
        x, y, z, w = quaternion(pose[:3, :3]).tolist()
        at = " ".join(repr(float(value * unit)) for value in pose[:3, 3])
        rows = " ".join(repr(float(value)) for value in pose[:3, :3].ravel())
        told = (
            f'<failure cause="{outcome}" />'
            if outcome.isupper()
            else f'<informal uri="rwgq0" quality="{outcome}" /><success quality="{outcome}" />'
        )
        grasps.append(
            f'<grasp><pose><position domain="R3"><euclidean>{at}</euclidean></position>'
            f'<orientation domain="SO3"><quaternion format="wxyz">{w!r} {x!r} {y!r} {z!r}</quaternion>'
            f"<rotmatrix>{rows}</rotmatrix></orientation></pose><outcome>{told}</outcome></grasp>"
        )
    path.write_text(
        '<?xml version="1.0"?>\n<experiments xmlns="http://iis.uibk.ac.at/ns/grasping">\n<experiment>'
        '<object type="mug"><notes> </notes></object><gripper type="PG70"><params>0.034</params></gripper>'
        f"<grasps><notes/>{''.join(grasps)}</grasps></experiment></experiments>\n"
    )
    return str(path)


def written(path: Path, data: Mapping[str, Any] | Sequence[Any]) -> str:
    """JSON in a file; its name."""
    path.write_text(json.dumps(data))
    return str(path)
