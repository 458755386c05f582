"""Requests made up from the OpenAPI document, by schemathesis, against a real server.

None is answered 5xx; what the document allows is refused by the rules alone that docs/http.md lists, for a
schema cannot say them; what is answered is as the document says. Half of the requests are mended, so that
they get past the first check: ids that exist, unit quaternions, cones that have their axis.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import httpx
import jsonschema_rs
import numpy as np
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from numpy.typing import NDArray
from schemathesis import Case, GenerationMode

import graspdb_service

DOCS = Path(__file__).parents[2] / "docs"
DOCUMENT = json.loads((DOCS / "openapi.json").read_text())
SCHEMA = schemathesis.openapi.from_dict(DOCUMENT)
OPERATIONS = {
    f"{found.ok().method.upper()} {found.ok().path}": found.ok() for found in SCHEMA.get_all_operations()
}
#: So that no request takes long, however much it asks for.
LIMITS = {
    "max_samples": 300,
    "max_query_poses": 300,
    "max_sweep_poses": 2_000,
    "report_wait_s": 0.5,
    "max_mesh_seconds": 60.0,
}

Serve = Callable[..., str]
Post = Callable[..., dict[str, Any]]
Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
Ids = dict[str, str]


@schemathesis.serializer(
    "model/stl", "model/obj", "model/ply", "model/gltf-binary", "application/vnd.apache.arrow.stream",
    "application/x-ndjson",
)  # fmt: skip
def _bytes(_: Any, value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


def _table(title: str) -> list[list[str]]:
    """The rows of the table under a heading of docs/http.md, without the marks of code."""
    text = (DOCS / "http.md").read_text().split(f"## {title}\n")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


PROBLEMS = [
    (kind, status, re.findall(r"`(.*?)`", where))
    for kinds, status, where, _ in _table("Problem types")
    for kind in re.findall(r"`(.*?)`", kinds)
]
RULES = [message.strip("`") for message, _ in _table("Rules that a schema cannot say")]


def test_every_type_of_problem_has_its_row() -> None:
    raised = set()
    for path in Path(graspdb_service.__file__).parent.rglob("*.py"):
        raised |= set(
            re.findall(r'(?:ProblemError|conflict)\(\s*(?:\d{3},\s*)?"([a-z-]+)"', path.read_text())
        )
    assert len(raised) > 40
    assert raised <= {kind for kind, _, _ in PROBLEMS}


def _mended(value: Any, name: str = "") -> Any:
    """A body or a query, nearer to what somebody would send."""
    if isinstance(value, dict):
        value = {key: _mended(item, key) for key, item in value.items()}
        for axis in ("approach", "closing"):
            if value.get(axis) is None:
                value.pop(f"{axis}_cone_deg", None)
            elif f"{axis}_cone_deg" not in value:
                value[f"{axis}_cone_deg"] = 30.0
        return value
    if name in ("gripper", "object", "kernel", "protocol", "source") and isinstance(value, str):
        return {"gripper": "pg70", "object": "thing", "protocol": "wrench"}.get(name, value)
    if name in ("quaternion_xyzw", "object_pose") and isinstance(value, list | tuple):
        if not value or isinstance(value[0], list | tuple):
            return [_mended(row, name) for row in value]
        if not all(isinstance(x, int | float) for x in value):
            return value
        turn = np.array(value[-4:], dtype=np.float64)
        turn = turn / np.linalg.norm(turn) if np.linalg.norm(turn) > 1e-3 else np.array([1.0, 0, 0, 0])
        return [*value[:-4], *turn.tolist()]
    if isinstance(value, list):
        return [_mended(item, name) for item in value]
    return value


def _aimed(case: Case, ids: Ids, name: str) -> Case:
    """At what there is, ``name`` the object."""
    own = {**ids, "objects": name}
    if (case.method == "DELETE" and case.path.count("{") == 1) or case.path.endswith("{batch}"):
        own |= {"objects": "spare", "gripper": "spare", "kernels": "spare"}
    for parameter in case.path_parameters:
        kind = case.path.split("/")[1] if parameter == "id" else parameter
        case.path_parameters[parameter] = own.get(kind, "1")
    case.query = _mended(case.query)
    if isinstance(case.body, dict | list):
        case.body = _mended(case.body)
    return case


def _documented(operation: str, answer: Any) -> str | None:
    """What a refusal of a valid request lacks in docs/http.md; None where it is there."""
    problem = answer.json()
    kind = problem["type"].removeprefix("urn:graspdb:problem:")
    listed = any(
        kind == name and str(answer.status_code) in status and any(fnmatchcase(operation, to) for to in where)
        for name, status, where in PROBLEMS
    )
    if not listed:
        return f"{kind} ({answer.status_code}) is not in the table of problem types for {operation}"
    if kind != "invalid-request":
        return None
    messages = [error["message"] for error in problem["errors"]]
    strange = [text for text in messages if not any(fnmatchcase(text, rule) for rule in RULES)]
    return f"not among the rules for {operation}: {strange}" if strange else None


def _conforms(operation: str, answer: Any) -> None:
    """The answer has a status and a body of the document."""
    method, path = operation.split()
    told = DOCUMENT["paths"][path][method.lower()]["responses"][str(answer.status_code)].get("content", {})
    media = answer.headers.get("content-type", [""])[0].partition(";")[0]
    if answer.content and media == "application/json":
        schema = {**told[media]["schema"], "components": DOCUMENT["components"]}
        jsonschema_rs.Draft202012Validator(schema).validate(answer.json())
    elif answer.content and told:
        assert media in told


def _ask(http: httpx.Client, operation: str, ids: Ids, mode: GenerationMode, count: int) -> None:
    session = requests.Session()
    base = str(http.base_url)

    @settings(
        max_examples=count,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],
    )
    @given(
        OPERATIONS[operation].as_strategy(generation_mode=mode),
        st.sampled_from(["as it is", "thing", "free"]),
    )
    def ask(case: Case, aim: str) -> None:
        if operation.startswith("DELETE /objects"):
            http.post("/objects", json={"id": "spare"})
        if aim != "as it is":
            case = _aimed(case, ids, aim)
        answer = case.call(base_url=base, session=session, timeout=120)
        told = f"{case.as_curl_command()[:2_000]}\n{answer.status_code} {answer.content[:1_000]!r}"
        # What takes longer than anybody is given on a slow machine is no failure.
        assert answer.status_code < 500 or b"problem:deadline" in answer.content, told
        if answer.status_code < 400:
            _conforms(operation, answer)
        else:
            assert answer.headers["content-type"][0] == "application/problem+json", told
            assert answer.status_code != 405, told
            if mode is GenerationMode.POSITIVE:
                lacking = _documented(operation, answer)
                assert lacking is None, f"{lacking}\n{told}"

    # Nothing can be wrong with a request that takes nothing.
    with suppress(Unsatisfiable):
        ask()


@pytest.fixture(scope="module")
def made() -> Callable[..., Ids]:
    """What requests are aimed at: objects with and without a mesh, trials, a sweep, a kernel, a job."""

    def make(http: httpx.Client, post: Post, put_box: Callable[..., Any], poses: Poses) -> Ids:
        for name in ("thing", "free"):
            http.post("/objects", json={"id": name, "mass_kg": 0.2}).raise_for_status()
        put_box(http, "thing")
        some = poses[0][:80], poses[1][:80]
        outcomes = ["failure" if i % 4 == 0 else "success" for i in range(80)]
        beside = {"gripper": "pg70", "protocol": "wrench", "source": "robot"}
        stored = {name: post(http, name, some, outcomes, **beside) for name in ("thing", "free")}
        grid = {"position_step_m": 0.05, "rotation_step_deg": 60.0, "max_poses": 50}
        sweep = http.post("/objects/thing/sweeps", json={"grid": grid, "gripper": "pg70"}).json()["id"]
        kernel = http.post("/kernels", json={"object": "thing", "gripper": "pg70"}).json()["id"]
        job = http.post("/jobs/claim", json={"worker": "w"}).json()["jobs"][0]
        return {
            "batch": stored["thing"]["batch"], "sweeps": sweep, "kernels": kernel, "gripper": "pg70",
            "seq": "1", "jobs": job["id"], "report-runs": "none",
        }  # fmt: skip

    return make


@pytest.fixture(scope="module")
def short(
    tmp_path_factory: pytest.TempPathFactory,
    serve_module: Serve,
    made: Callable[..., Ids],
    post: Post,
    put_box: Callable[..., Any],
    two_clusters: Poses,
) -> Iterator[tuple[httpx.Client, Ids]]:
    database = tmp_path_factory.mktemp("generated") / "graspdb.sqlite"
    with httpx.Client(base_url=serve_module(f"sqlite:///{database}", **LIMITS), timeout=120) as http:
        yield http, made(http, post, put_box, two_clusters)


@pytest.mark.parametrize("operation", OPERATIONS)
def test_some_requests(short: tuple[httpx.Client, Ids], operation: str) -> None:
    _ask(short[0], operation, short[1], GenerationMode.POSITIVE, 10)
    _ask(short[0], operation, short[1], GenerationMode.NEGATIVE, 4)


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_many_requests(
    database_url: str,
    serve: Serve,
    made: Callable[..., Ids],
    post: Post,
    put_box: Callable[..., Any],
    two_clusters: Poses,
) -> None:
    with httpx.Client(base_url=serve(database_url, **LIMITS), timeout=120) as http:
        ids = made(http, post, put_box, two_clusters)
        failed = []
        for operation in OPERATIONS:
            for mode, count in ((GenerationMode.POSITIVE, 200), (GenerationMode.NEGATIVE, 60)):
                try:
                    _ask(http, operation, ids, mode, count)
                except AssertionError as error:
                    # It takes minutes: all that fails is told at once.
                    failed.append(str(error)[:2_000])
        assert not failed, "\n\n".join(failed)
