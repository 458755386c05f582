"""GraspDB for agents, by the protocol's own client: in this process, as a program, and over HTTP."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from mcp import Client as Agent
from mcp import StdioServerParameters
from mcp.shared.exceptions import MCPError

from graspdb import Client
from graspdb.agents import build_server
from graspdb.agents.guide import PAGES
from graspdb.processes import ChildProcess
from graspdb.transport import Transport

COMMAND = str(Path(sys.executable).with_name("graspdb"))
READING = {
    *("objects", "object_details", "trials", "sweeps", "grippers", "frames", "convert_pose"),
    *("density", "best_grasp", "likelihood", "report"),
}


@pytest.fixture(scope="module")
def tried(service_url: str) -> str:
    """An object with 120 trials with the Panda, most of them successes about one pose."""
    random = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (120, 1, 1))
    poses[:, :3, 3] = random.normal([0.0, 0.0, 0.1], 0.01, size=(120, 3))
    with Client(service_url) as db:
        made = db.objects.create("agents-cup")
        made.trials.add(poses, random.random(120) < 0.7, gripper="panda", source="robot")
    return "agents-cup"


def asking(server: Any, *calls: tuple[str, dict[str, Any]]) -> list[Any]:
    """The results of tools called one after the other by an agent."""

    async def ask() -> list[Any]:
        async with Agent(server) as agent:
            return [await agent.call_tool(name, arguments) for name, arguments in calls]

    return anyio.run(ask)


def value(result: Any) -> dict[str, Any]:
    """What a tool answered, which it says as words, too."""
    assert not result.is_error, result.content
    assert json.loads(result.content[0].text) == result.structured_content
    found: dict[str, Any] = result.structured_content
    return found


@pytest.fixture
def server(service_url: str) -> Iterator[Any]:
    with Transport(service_url, retries=0) as transport:
        yield build_server(transport)


def test_an_agent_finds_where_the_flange_goes(server: Any, tried: str, service_url: str) -> None:
    question = {
        "frame": "flange",
        "object_pose": {"position": [0.5, 0, 0.2], "quaternion_xyzw": [0, 0, 0, 1]},
    }
    objects, best = asking(
        server, ("objects", {"limit": 100}), ("best_grasp", {"object": tried, "question": question})
    )
    assert tried in {item["id"] for item in value(objects)["items"]}
    answer = value(best)
    with Client(service_url) as db:
        expected = db.objects.get(tried).best_grasp(frame="flange", object_pose=[0.5, 0, 0.2, 0, 0, 0, 1])
    np.testing.assert_allclose(answer["grasps"][0]["world"]["position"], expected.world[:3, 3], atol=1e-9)
    assert answer["frame"] == "flange"
    assert 0.5 < answer["grasps"][0]["success_probability"] < 1.0


def test_an_agent_turns_poses_of_one_frame_into_another(server: Any, tried: str) -> None:
    tool = {"position": [0.1, -0.2, 0.3], "quaternion_xyzw": [0.5, -0.5, 0.5, 0.5]}
    there, told = asking(
        server,
        ("convert_pose", {"gripper": "panda", "pose": tool, "from_frame": "tool", "to_frame": "flange"}),
        ("frames", {"gripper": "panda"}),
    )
    flange = {name: value(there)[name] for name in ("position", "quaternion_xyzw")}
    assert flange != tool
    (back,) = asking(
        server,
        ("convert_pose", {"gripper": "panda", "pose": flange, "from_frame": "flange", "to_frame": "tool"}),
    )
    np.testing.assert_allclose(value(back)["position"], tool["position"], atol=1e-12)
    np.testing.assert_allclose(np.abs(value(back)["quaternion_xyzw"]), 0.5, atol=1e-12)
    assert {"base", "tool", "flange"} <= value(told)["poses_in_base"].keys()


def test_reports_and_likelihoods_are_read(server: Any, tried: str) -> None:
    poses = [{"position": [0, 0, 0.1], "quaternion_xyzw": [0, 0, 0, 1]}] * 2
    likelihood, report, projection = asking(
        server,
        ("likelihood", {"object": tried, "question": {"poses": poses}}),
        ("report", {"object": tried, "report": "calibration"}),
        ("report", {"object": tried, "report": "projection", "options": {"plane": "xy"}}),
    )
    assert len(value(likelihood)["success_probability"]) == 2
    assert value(report)["text"]
    assert value(projection)["cut"], "a picture's grid is longer than what is read"


def test_refusals_are_words_to_act_on(server: Any, tried: str) -> None:
    unknown, wrong, many = asking(
        server,
        ("object_details", {"object": "nowhere"}),
        ("best_grasp", {"object": tried, "question": {"frame": "elbow"}}),
        ("likelihood", {"object": tried, "question": {"poses": {
            "position": [[0, 0, 0]] * 201, "quaternion_xyzw": [[0, 0, 0, 1]] * 201}}}),
    )  # fmt: skip
    assert unknown.is_error
    assert "nowhere" in unknown.content[0].text
    assert wrong.is_error
    assert "elbow" in wrong.content[0].text
    assert "flange" in wrong.content[0].text
    assert many.is_error
    assert "200" in many.content[0].text


def test_a_service_that_is_down_is_said() -> None:
    with Transport("http://127.0.0.1:9", retries=0) as transport:
        (found,) = asking(build_server(transport), ("objects", {}))
    assert found.is_error
    assert "Is the service running" in found.content[0].text


def test_what_writes_is_there_only_where_it_was_allowed(service_url: str, tried: str) -> None:
    trial = {"position": [0, 0, 0.1], "quaternion_xyzw": [0, 0, 0, 1], "outcome": True, "gripper": "panda"}
    batch = {"object": tried, "trials": {"trials": [trial]}, "key": "batch-of-today"}

    async def names(server: Any) -> dict[str, bool | None]:
        async with Agent(server) as agent:
            tools = (await agent.list_tools()).tools
        return {tool.name: tool.annotations and tool.annotations.read_only_hint for tool in tools}

    with Transport(service_url, retries=0) as transport:
        assert anyio.run(names, build_server(transport)) == dict.fromkeys(READING, True)
        writing = build_server(transport, write=True)
        assert {name for name, reads in anyio.run(names, writing).items() if not reads} == {
            "add_trials",
            "start_sweep",
        }
        first, again, flange = asking(
            writing,
            ("add_trials", batch),
            ("add_trials", batch),
            ("add_trials", {**batch, "key": "by-the-flange", "frame": "flange"}),
        )
    assert value(first)["inserted"] == 1
    assert value(again)["batch"] == value(first)["batch"]
    with Client(service_url) as db:
        (stored,) = db.objects.get(tried).trials.list(batch=value(flange)["batch"])
        (back,) = db.objects.get(tried).trials.list(batch=value(flange)["batch"], frame="flange")
    assert stored.position != pytest.approx((0, 0, 0.1))
    assert back.position == pytest.approx((0, 0, 0.1))


def test_the_guide_and_pictures_are_read(server: Any, tried: str) -> None:
    async def read(*uris: str) -> list[Any]:
        async with Agent(server) as agent:
            with pytest.raises(MCPError, match="no page 'nothing'"):
                await agent.read_resource("graspdb://guide/nothing")
            return [(await agent.read_resource(uri)).contents[0] for uri in uris]

    contents, guide, gripper, figure = anyio.run(
        read,
        "graspdb://guide",
        "graspdb://guide/frames",
        "graspdb://grippers/panda.png",
        f"graspdb://objects/{tried}/reports/projection.png",
    )
    assert all(name in contents.text for name in PAGES)
    assert guide.text.startswith("# Frames")
    for picture in (gripper, figure):
        assert picture.mime_type == "image/png"
        assert picture.blob.startswith("iVBORw0KGgo")


def test_the_command_serves_a_program_over_its_own_pipes(service_url: str, tried: str) -> None:
    command = StdioServerParameters(command=COMMAND, args=["--url", service_url, "mcp"], env=dict(os.environ))
    (found,) = asking(command, ("object_details", {"object": tried}))
    assert value(found)["id"] == tried


def test_the_command_serves_this_machine_over_http(
    service_url: str, tried: str, eventually: Callable[..., Any]
) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = ChildProcess(
        [COMMAND, "--url", service_url, "mcp", "--http", "--port", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )

    def listening() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    try:
        eventually(listening)
        (found,) = asking(f"http://127.0.0.1:{port}/mcp", ("object_details", {"object": tried}))
        assert value(found)["id"] == tried
    finally:
        process.terminate()
        process.wait(30)
