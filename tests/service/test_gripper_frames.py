"""A gripper's frames and joints: named, checked, versioned."""

from __future__ import annotations

from typing import Any

import httpx

MINE: dict[str, Any] = {
    "id": "mine",
    "max_opening_m": 0.05,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
}
IDENTITY = {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}
TOOL = {"position": [0, 0, 0.12], "quaternion_xyzw": [0, 0, 0, 1]}
FLANGE = {"position": [0, 0, -0.02], "quaternion_xyzw": [0, 0, 0, 1]}
BACK = {"position": [0, 0, 0.14], "quaternion_xyzw": [1, 0, 0, 0]}
DOUBTFUL: list[tuple[dict[str, Any], str]] = [
    ({"base_to_tool": BACK}, "base_to_tool puts the gripper's base 130 mm ahead of its fingertips"),
    (
        {"base_to_tool": TOOL, "frames": {"flange": {**TOOL, "position": [0, 0, 0.136]}}},
        "frames.flange puts the gripper's flange 6 mm ahead of its fingertips",
    ),
    ({"joints": {"j": {"open": 40, "closed": 0}}}, "joints.j.open is 40, which no jaw's is"),
]


def test_frames_are_read_back_with_base_and_tool(http: httpx.Client) -> None:
    made = http.post(
        "/grippers",
        json={**MINE, "frames": {"tool": TOOL, "flange": FLANGE}, "joints": {"j": {"open": 1, "closed": 0}}},
    )
    assert made.status_code == 201, made.text
    profile = http.get("/grippers/mine").json()["profile"]
    assert profile["frames"] == {"base": IDENTITY, "tool": TOOL, "flange": FLANGE}
    assert (profile["base_to_tool"], profile["joints"]) == (TOOL, {"j": {"open": 1, "closed": 0}})
    panda = http.get("/grippers/panda").json()["profile"]
    assert panda["frames"]["tool"] == panda["base_to_tool"]
    assert panda["frames"]["base"] == IDENTITY


def test_a_version_has_its_own_frames(http: httpx.Client) -> None:
    http.post("/grippers", json={**MINE, "base_to_tool": TOOL})
    rest = {name: value for name, value in MINE.items() if name != "id"}
    told = {**rest, "base_to_tool": TOOL, "frames": {"flange": FLANGE}}
    second = http.put("/grippers/mine", json=told).json()
    assert (second["version"], second["changed"]) == (2, ["frames.flange"])
    # What an answer tells is the same profile again.
    assert http.put("/grippers/mine", json=second["profile"]).json()["version"] == 2
    assert "flange" not in http.get("/grippers/mine@1").json()["profile"]["frames"]


def test_frames_that_contradict_name_the_field(sqlite_http: httpx.Client) -> None:
    cases = [
        ({"base_to_tool": FLANGE, "frames": {"tool": TOOL}}, "frames"),
        ({"frames": {"world": TOOL}}, "frames"),
        ({"frames": {"object": TOOL}}, "frames"),
        ({"frames": {"base": TOOL}}, "frames"),
        (
            {"frames": {"flange": {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 2]}}},
            "frames.flange.quaternion_xyzw",
        ),
        ({"frames": {"a b": TOOL}}, "frames.a b"),
        ({"frames": {f"f{i}": TOOL for i in range(65)}}, "frames"),
        ({"base_to_tool": {"position": [0, 0, 162], "quaternion_xyzw": [0, 0, 0, 1]}}, "body"),
        ({"joints": {"j": {"open": 1}}}, "joints.j.closed"),
        ({"joints": {"j": {"open": 1e9, "closed": 0}}}, "joints.j.open"),
    ]
    for change, field in [*cases, *[(change, "body") for change, _ in DOUBTFUL]]:
        refused = sqlite_http.post("/grippers", json={**MINE, **change})
        assert refused.status_code == 422, change
        assert [error["field"] for error in refused.json()["errors"]] == [field]
    told = sqlite_http.post("/grippers", json={**MINE, **cases[0][0]}).json()["errors"][0]["message"]
    assert "base_to_tool" in told
    for change, said in DOUBTFUL:
        refused = sqlite_http.post("/grippers", json={**MINE, **change}).json()["errors"][0]["message"]
        assert refused.startswith(said)
    assert "mine" not in [item["id"] for item in sqlite_http.get("/grippers").json()["items"]]
