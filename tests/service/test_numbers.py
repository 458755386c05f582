"""Numbers at the ends of floating point, in every field that takes one: refused by name, or right."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

Serve = Callable[..., str]
Post = Callable[..., dict[str, Any]]
Put = Callable[..., Any]
Poses = tuple[NDArray[np.float64], NDArray[np.float64]]

JSON = {"Content-Type": "application/json"}
ENDS = (
    *("1e308", "-1e308", "5e-324", "1e-300", "-0.0", "0", "1e16", "-1e-9", "9007199254740993", "true"),
    *("9223372036854775808", "-9223372036854775809", "18446744073709551616", f"1{'0' * 400}"),
    *("1e999", "-1e999", "NaN", "Infinity", "-Infinity", '"1"', "null", "[]", "{}"),
)
POSE = {"position": [0.0, 0.01, 0.06], "quaternion_xyzw": [1.0, 0.0, 0.0, 0.0]}
MATRIX = {"matrix": [[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, 0.06], [0, 0, 0, 1.0]]}
CLOSE = {"position": [0.0, 0.0, 0.05], "quaternion_xyzw": [1.0, 0.0, 0.0, 0.0]}
WIDTHS = {"sigma_position_m": 0.01, "sigma_rotation_deg": 10.0}
NOISE = {"pose_noise_m": 0.001, "pose_noise_deg": 1.0, "tool_noise_m": 0.001, "tool_noise_deg": 1.0}
CONSTRAINTS = {
    "count": 2,
    "box_min": [-0.1, -0.1, -0.1],
    "box_max": [0.1, 0.1, 0.2],
    "sphere": [0.0, 0.0, 0.05, 0.2],
    "above_plane": [0.0, 0.0, 1.0, 0.0],
    "approach": [0.0, 0.0, -1.0],
    "approach_cone_deg": 60.0,
    "closing": [0.0, 1.0, 0.0],
    "closing_cone_deg": 180.0,
    "pregrasp_distance_m": 0.05,
    "max_width_m": 0.08,
    "min_success_probability": 0.01,
    "min_effective_trials": 0.1,
    "object_pose": [0.5, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0],
    "min_separation_m": 0.01,
    "min_separation_deg": 20.0,
}
COVARIANCE = np.diag([1e-4] * 3 + [0.01] * 3).tolist()
GAUSSIAN = {"weight": 1.0, "mean": [0.0] * 6, "covariance": COVARIANCE}
GRIPPER = {
    "id": "mine",
    "max_opening_m": 0.05,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
    "finger_mass_kg": 0.1,
    "max_speed_m_s": 0.05,
    "max_acceleration_m_s2": 1.0,
    "force_n": 20.0,
    "friction": 0.5,
    "base_to_tool": {**POSE, "quaternion_xyzw": [0.0, 0.0, 1.0, 0.0]},
}
TRIAL = {
    **POSE,
    "outcome": True,
    "proposal_density": 1.0,
    "quality": 0.5,
    "width_m": 0.03,
    "pose_covariance": COVARIANCE,
    "metadata": {"a": 1.0},
}
BODIES: list[tuple[str, str, dict[str, Any]]] = [
    ("POST", "/objects", {"id": "cup", "mass_kg": 0.1, "density_kg_m3": 900.0, "friction": 0.4}),
    ("PATCH", "/objects/spare", {"mass_kg": 0.1, "density_kg_m3": 900.0, "friction": 0.4}),
    ("POST", "/grippers", GRIPPER),
    ("POST", "/grippers", {**GRIPPER, "base_to_tool": {"matrix": np.eye(4).tolist()}}),
    ("POST", "/objects/spare/trials", TRIAL),
    ("POST", "/objects/spare/trials", {**MATRIX, "outcome": True}),
    ("POST", "/objects/spare/trials", {"trials": [TRIAL], "proposal_density": 2.0}),
    ("POST", "/objects/spare/trials", {"columns": {name: [value] for name, value in TRIAL.items()}}),
    ("PATCH", "/objects/thing/trials/1", {"metadata": {"a": 1.0}}),
    ("POST", "/objects/thing/likelihood", {"poses": [POSE], "kernel": {"cutoff": 8.0, **WIDTHS}}),
    ("POST", "/objects/thing/likelihood", {"poses": [MATRIX], **WIDTHS}),
    (
        "POST",
        "/objects/thing/likelihood",
        {"poses": {"position": [[0, 0, 0.1]], "quaternion_xyzw": [[1, 0, 0, 0]]}},
    ),
    ("POST", "/objects/thing/best-grasp", CONSTRAINTS),
    (
        "POST",
        "/objects/thing/best-grasp",
        {"objective": "success_probability", "sphere": [0.0, 0.0, 0.05, 0.2]},
    ),
    ("POST", "/objects/thing/best-grasp", {"objective": "robust", **NOISE}),
    (
        "POST",
        "/objects/thing/best-grasp",
        {"kernel": {"cutoff": 8.0, **WIDTHS}, "half_spaces": [[0.0, 0.0, 1.0, 0.0]]},
    ),
    (
        "POST",
        "/objects/thing/best-grasp",
        {
            "object_pose": POSE,
            "obstacles": {
                "boxes": [{**POSE, "size_m": [0.01, 0.01, 0.01]}],
                "points": [[0.0, 0.0, 0.3]],
                "point_radius_m": 0.01,
            },
        },
    ),
    ("POST", "/objects/thing/best-grasp", {"candidates": [POSE, MATRIX], "exclude": [CLOSE]}),
    ("POST", "/objects/thing/samples", {"count": 3, "seed": 1, **WIDTHS}),
    ("POST", "/objects/thing/proposals", {"count": 3, "seed": 1, "strategy": "uncertainty"}),
    (
        "POST",
        "/objects/thing/proposals",
        {"count": 3, "seed": 1, "strategy": "edges", "gripper": "pg70", **WIDTHS},
    ),
    ("POST", "/kernels", {"components": [GAUSSIAN, GAUSSIAN], "gripper": "pg70"}),
    (
        "POST",
        "/kernels",
        {"object": "thing", "window": {"position_m": 0.03, "rotation_deg": 45.0}, "components": 2},
    ),
    (
        "POST",
        "/kernels",
        {"object": "thing", "kind": "sampled", "component_widths": WIDTHS, "components": 20},
    ),
    ("POST", "/kernels", {"kind": "sampled", "components": [{"mean": [0.0] * 6, "weight": 1.0}]}),
    ("POST", "/kernels", {"kind": "probability", "components": [GAUSSIAN]}),
    (
        "POST",
        "/objects/thing/sweeps",
        {
            "grid": {
                "position_step_m": 0.02,
                "rotation_step_deg": 30.0,
                "margin_m": 0.02,
                "region": {"lower": [-0.1, -0.1, -0.1], "upper": [0.1, 0.1, 0.1]},
                "max_poses": 10,
                "seed": 1,
            },
            "chunk_poses": 100,
        },
    ),
    ("POST", "/objects/thing/sweeps", {"poses": [POSE, MATRIX], "proposal_density": [1.0, 2.0]}),
    ("POST", "/objects/thing/sweeps", {"sample": {"kernel": WIDTHS, "count": 3, "seed": 1}}),
    ("POST", "/jobs/claim", {"worker": "w", "capabilities": ["none"], "limit": 1}),
]


def _places(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of the numbers in a document, of a list or row of alike ones the first and the last."""
    if isinstance(document, dict):
        items: Any = document.items()
    elif isinstance(document, list):
        items = enumerate(document)
        if len(document) > 2:
            items = [(0, document[0]), (len(document) - 1, document[-1])]
    else:
        is_number = isinstance(document, int | float) and not isinstance(document, bool)
        return [path] if is_number else []
    return [found for key, value in items for found in _places(value, (*path, key))]


def _with(document: Any, path: tuple[Any, ...], literal: str) -> bytes:
    """The document as text with one number replaced by a literal."""
    copy = json.loads(json.dumps(document))
    place = copy
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = "@"
    return json.dumps(copy).replace('"@"', literal).encode()


def _prepare(http: httpx.Client, post: Post, put_box: Put, poses: Poses) -> None:
    for name in ("thing", "spare"):
        http.post("/objects", json={"id": name, "mass_kg": 0.2}).raise_for_status()
    put_box(http, "thing")
    some = poses[0][:80], poses[1][:80]
    outcomes = ["failure" if i % 4 == 0 else "success" for i in range(80)]
    post(http, "thing", some, outcomes, gripper="pg70", protocol="lift", source="robot")


def _undo(http: httpx.Client, path: str, answer: httpx.Response) -> None:
    """Free what a creating request made, so that the next of its kind can make it again."""
    made = {"/objects": "cup", "/grippers": "mine", "/kernels": answer.json().get("id")}.get(path)
    if answer.status_code == 201 and made is not None:
        assert http.delete(f"{path}/{made}").status_code == 204


def _check(http: httpx.Client, method: str, path: str, body: bytes, place: tuple[Any, ...]) -> None:
    answer = http.request(method, path, content=body, headers=JSON)
    told = (method, path, body[:300], answer.status_code, answer.text[:500])
    assert answer.status_code < 500, told
    assert "NaN" not in answer.text, told
    assert "Infinity" not in answer.text, told
    _undo(http, path, answer)
    if answer.status_code >= 400 and answer.status_code not in (409, 413):
        assert answer.status_code == 422, told
        named = [error["field"] for error in answer.json()["errors"]]
        assert any(field.split(".")[0] == str(place[0]) for field in named), told


def _answers(http: httpx.Client) -> list[Any]:
    best, told = (http.get(f"/objects/thing/{name}").json() for name in ("best-grasp", "density"))
    return [best["grasps"], *(told[name] for name in ("kernel", "size", "outcomes", "weights"))]


def test_no_number_breaks_an_answer(asked: httpx.Client) -> None:
    """In turn, so that every field meets one of the ends and every end some fields."""
    _send_numbers(asked, every=19)


@pytest.mark.long
@pytest.mark.timeout(1_800)
def test_not_one_number_breaks_an_answer(
    http: httpx.Client, post: Post, put_box: Put, two_clusters: Poses
) -> None:
    _prepare(http, post, put_box, two_clusters)
    _send_numbers(http, every=1)


def _send_numbers(http: httpx.Client, every: int) -> None:
    before = _answers(http)
    turn = 0
    for method, path, document in BODIES:
        valid = http.request(method, path, json=document)
        assert valid.status_code < 300, (method, path, valid.text)
        _undo(http, path, valid)
        for place in _places(document):
            for literal in ENDS:
                turn += 1
                if turn % every == 0:
                    _check(http, method, path, _with(document, place, literal), place)
    assert _answers(http) == before


QUERIES = [
    "density?sigma_position_m={}",
    "density?sigma_rotation_deg={}",
    "likelihood?position={},0,0.06&quaternion_xyzw=1,0,0,0",
    "likelihood?position=0,0,0.06&quaternion_xyzw=1,0,0,{}",
    "best-grasp?count={}",
    "best-grasp?above_plane={0},{0},{0},{0}",
    "best-grasp?above_plane=0,0,{},0",
    "best-grasp?sphere=0,0,0,{}",
    "best-grasp?approach={0},{0},0&approach_cone_deg=10",
    "best-grasp?approach=0,0,-1&approach_cone_deg={}",
    "best-grasp?box_min={0},{0},{0}",
    "best-grasp?pregrasp_distance_m={}",
    "best-grasp?max_width_m={}",
    "best-grasp?object_pose={0},0,0,0,0,0,1",
    "best-grasp?min_separation_m={0}&min_separation_deg={0}&count=50",
    "best-grasp?min_success_probability={}",
    "best-grasp?min_effective_trials={}",
    "trials?since_revision={}",
    "trials?limit={}",
    "trials/{}",
    "reports/projection?plane={},0,0",
    "reports/projection?approach=0,0,{}&approach_cone_deg=10",
    "reports/kernel-similarity?window_position_m={}",
    "reports/kernel-similarity?window_rotation_deg={}",
    "reports/kernel-similarity?component_position_m={}",
    "reports/bandwidth?sigma_position_m={}",
    "reports/sources?sigma_position_m={}",
]


@pytest.mark.parametrize("query", QUERIES)
def test_no_number_breaks_a_query(asked: httpx.Client, query: str) -> None:
    for literal in ENDS:
        answer = asked.get(f"/objects/thing/{query.format(literal.strip(chr(34)))}")
        assert answer.status_code < 500, (query, literal, answer.text[:300])
        assert "NaN" not in answer.text.replace("is NaN", ""), (query, literal)


@pytest.fixture(scope="module")
def asked(
    tmp_path_factory: pytest.TempPathFactory,
    serve_module: Serve,
    post: Post,
    put_box: Put,
    two_clusters: Poses,
) -> Iterator[httpx.Client]:
    database = tmp_path_factory.mktemp("numbers") / "graspdb.sqlite"
    with httpx.Client(base_url=serve_module(f"sqlite:///{database}"), timeout=240) as http:
        _prepare(http, post, put_box, two_clusters)
        yield http


POISON = {
    "least proposal density": [{"proposal_density": 1e-30}],
    "proposal densities far apart": [{"proposal_density": 1e15}, {"proposal_density": 1e-30}],
    "a kilometre away": [{"position": [1000.0, -1000.0, 1000.0]}],
    "smallest numbers": [{"position": [5e-324, -0.0, 5e-324], "quality": 5e-324, "width_m": 5e-324}],
    "largest numbers": [{"quality": 1e9, "width_m": 10.0, "pose_covariance": np.diag([1e6] * 6).tolist()}],
    "one pose many times": [{}] * 60,
}


@pytest.mark.parametrize("more", POISON.values(), ids=POISON)
def test_a_strange_trial_spoils_no_answer(
    sqlite_http: httpx.Client, post: Post, make_object: Callable[..., str], two_clusters: Poses, more: Any
) -> None:
    """The best grasp stays among the many, and where few weights count, the answer says so."""
    poses = two_clusters[0][:200], two_clusters[1][:200]
    make_object(sqlite_http)
    post(sqlite_http, "thing", poses, gripper="pg70", proposal_density=[100.0] * 200)
    before = sqlite_http.get("/objects/thing/best-grasp").json()
    beside = {"gripper": "pg70", "trials": [{**POSE, "outcome": True, **trial} for trial in more]}
    answer = sqlite_http.post("/objects/thing/trials", json=beside)
    assert answer.status_code == 201, answer.text
    after = sqlite_http.get("/objects/thing/best-grasp").json()
    told = sqlite_http.get("/objects/thing/density").json()
    assert np.linalg.norm(np.subtract(*(a["grasps"][0]["position"] for a in (before, after)))) < 0.02
    assert told["effective_sample_size"] > 40 or "very uneven" in told["warnings"][0]
    for report in ("anisotropy", "projection", "convergence", "bandwidth", "calibration"):
        assert sqlite_http.get(f"/objects/thing/reports/{report}").status_code in (200, 202, 409)
