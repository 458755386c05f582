"""The pages of ``docs``: their code, block by block as it stands there, and how to run it."""

from __future__ import annotations

import ast
import asyncio
import inspect
import os
import re
import shlex
import subprocess
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import tomllib

from real_processes import Process, running, wait_for

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def pages() -> list[Path]:
    """The site's pages that are written by hand, in its order."""
    chapters = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))["project"]["nav"]
    entries = [entry for chapter in chapters for entry in chapter.values()]
    names = [name for entry in entries for name in (entry if isinstance(entry, list) else [entry])]
    return [DOCS / name for name in names if not name.startswith("reference/")]


def blocks(page: Path, language: str) -> list[tuple[int, str]]:
    """The blocks of a language with the line that each starts on."""
    text = page.read_text(encoding="utf-8")
    found = re.finditer(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [(text[: match.start(1)].count("\n"), match.group(1)) for match in found]


def execute(page: Path, line: int, block: str, names: dict[str, Any]) -> None:
    """Run a block in a namespace; errors name the page's line."""
    code = compile("\n" * line + block, str(page), "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    if code.co_flags & inspect.CO_COROUTINE:
        asyncio.run(types.FunctionType(code, names)())
    else:
        exec(code, names)  # noqa: S102 - the guide is ours


def typed(block: str, folder: Path, **environment: str) -> str:
    """What a shell says to a block of commands, all of which must work; what installs is left out."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-ec", re.sub(r"^pip install .*$", "", block, flags=re.MULTILINE)],
        cwd=folder,
        env={**os.environ, "PATH": path, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, block + done.stdout + done.stderr
    return done.stdout


@contextmanager
def going_on(
    command: str, folder: Path, address: str, *, verify: Any = True, **environment: str
) -> Iterator[None]:
    """A command that serves until it is stopped, from when its address answers."""
    process = Process(folder / "served.log", *shlex.split(command, comments=True), cwd=folder, **environment)

    def answers() -> bool:
        assert process.is_running(), process.log()
        return httpx.get(address, verify=verify, follow_redirects=True).is_success

    with running(process):
        wait_for(f"{command} answers", answers)
        yield
        assert process.is_running(), process.log()
