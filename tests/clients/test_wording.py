"""Ways out in the words of the command line: every request that the service names has its command."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh

from graspdb.cli.wording import COMMANDS, in_commands

SERVICE = Path(__file__).parents[2] / "service" / "graspdb_service"
REQUEST = re.compile(r"(GET|POST|PUT|DELETE|PATCH) /")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("GET /grippers lists them", "`graspdb grippers list` lists them"),
        ("post trials (POST /objects/mug/trials)", "post trials (`graspdb trials add mug FILE`)"),
        ("cancel it (POST /sweeps/{id}/cancel)", "cancel it (`graspdb sweeps cancel SWEEP`)"),
        (
            'fit one with POST /kernels {"object": "mug", "gripper": "pg70"}; there are',
            "fit one with `graspdb kernels fit mug --gripper pg70`; there are",
        ),
        (
            'POST /objects/mug/sweeps {"poses": [...], "purpose": "check"}, as best_grasps(count=25) does',
            "`graspdb sweep mug --poses FILE --purpose check`, as best_grasps(count=25) does",
        ),
        ('POST /objects/a/sweeps {"sample": {"count": 9, "seed": 1}}', "`graspdb sweep a --sample 9`"),
        ("PATCH /objects/mug with mass_kg", "`graspdb objects change mug` with --mass-kg"),
        ("PUT /objects/mug/mesh?unit=... again", "`graspdb objects set-mesh mug FILE --unit ...` again"),
        ("  approach_cone_deg: the half angle", "  --approach-cone-deg: the half angle"),
        ("name one (gripper=) or use alignment=gripper", "name one (--gripper) or use --alignment gripper"),
        (
            "post them with ?accept_implausible=true (on the command line --accept-implausible)",
            "post them with --accept-implausible",
        ),
        (
            "The trials are of several grippers: name one (gripper: panda, pg70; protocol: a, b)",
            "The trials are of several grippers: name one (--gripper: panda, pg70; --protocol: a, b)",
        ),
        ("is not known: name one (gripper)", "is not known: name one (--gripper)"),
        (
            "invalid input:\n  near: four numbers\n  id: text",
            "invalid input:\n  --near: four numbers\n  id: text",
        ),
        ("object_pose must have a unit quaternion", "--object-pose must have a unit quaternion"),
        ("if the file is in millimetres, send unit=mm", "if the file is in millimetres, send --unit mm"),
        ("by 0.001 (on the command line --unit mm)", "by 0.001 (--unit mm)"),
        ("collision_free=false would do", "--any would do"),
        ("trials.1.quaternion_xyzw: norm 3", "trials.1.quaternion_xyzw: norm 3"),
        ("GET /somewhere/else is unknown", "GET /somewhere/else is unknown"),
    ],
)
def test_requests_and_parameters_are_commands_and_options(text: str, said: str) -> None:
    assert in_commands(text) == said


class _Texts(ast.NodeVisitor):
    """Every text of a module, with ``{id}`` for what is put into it."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        parts = [str(part.value) if isinstance(part, ast.Constant) else "{id}" for part in node.values]
        self.found.append("".join(parts))

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str):
            self.found.append(node.value)


def _messages() -> list[str]:
    texts = _Texts()
    for path in (SERVICE / "usecases").rglob("*.py"):
        texts.visit(ast.parse(path.read_text()))
    return texts.found


def test_every_request_that_the_service_names_has_a_command() -> None:
    named = [text for text in _messages() if REQUEST.search(text)]
    assert len(named) > 20
    left = [text for text in named if REQUEST.search(in_commands(text))]
    assert not left, "name their commands in graspdb.cli.wording.COMMANDS"


def test_every_command_exists(help_of: Callable[..., str]) -> None:
    for command in COMMANDS.values():
        assert help_of("graspdb", *(word for word in command.split() if not word.isupper()))


def test_errors_speak_of_commands(run: Callable[..., tuple[int, str, str]], fresh_id: str) -> None:
    run("objects", "create", fresh_id)
    code, _, err = run("best-grasp", fresh_id, "--kernel", "anisotropic")
    assert code == 1
    assert f"`graspdb kernels fit {fresh_id}`" in err
    assert "POST" not in err
    code, _, err = run("best-grasp", fresh_id, "--approach", "0,0,1")
    assert code == 1
    assert "--approach-cone-deg: " in err
    for arguments, option in (
        (("best-grasp", fresh_id, "--object-pose", "0,0,0,0,0,0,2"), "--object-pose must have a unit"),
        (("likelihood", fresh_id, "--pose", "0,0,0,0,0,0,2"), "--pose must have a unit"),
        (("best-grasp", fresh_id, "--near", "0,0,0,2"), "  --near: "),
    ):
        assert option in run(*arguments)[2]


def test_a_mesh_in_another_unit_is_told_of_the_option(
    run: Callable[..., tuple[int, str, str]], fresh_id: str, tmp_path: Path
) -> None:
    file = tmp_path / "seven.stl"
    file.write_bytes(bytes(trimesh.creation.box([7, 7, 7]).export(file_type="stl")))
    assert "send --unit mm" in run("objects", "create", fresh_id, "--mesh", str(file))[1]
