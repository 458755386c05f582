"""The lab of ``compose.yaml`` in namespaces of its own: podman-compose, and what an engine would see to."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

ROOT = Path(__file__).resolve().parents[2]
PROJECT = "graspdb"


def say(what: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {what}", flush=True)


class Failed(RuntimeError):
    """A command ended otherwise than it should."""


def command(*words: str, inputs: bytes | None = None, **environment: str) -> str:
    """Run a command and return what it printed; Failed with all it said."""
    done = subprocess.run(
        words,
        cwd=ROOT,
        env={**os.environ, **environment},
        input=inputs,
        capture_output=True,
        check=False,
    )
    if done.returncode:
        said = (done.stdout + done.stderr).decode(errors="replace")[-4000:]
        raise Failed(f"{' '.join(words)} ended with {done.returncode}:\n{said}")
    return done.stdout.decode(errors="replace")


def wait_for(what: str, condition: Callable[[], Any], seconds: float = 600.0) -> Any:
    """What a condition comes to, asked again and again; one that fails does not hold."""
    deadline = time.monotonic() + seconds
    error: Exception | None = None
    while time.monotonic() < deadline:
        try:
            if found := condition():
                return found
        except (OSError, Failed, ValueError, httpx.TransportError) as raised:
            error = raised
        time.sleep(0.5)
    raise Failed(f"{what}: not within {seconds:g} s ({error})")


class Compose:
    """The project of ``compose.yaml``, with variables of its own.

    podman here has neither systemd, which would look at health, nor the waiting for it: conditions of
    ``depends_on`` are waited for by :meth:`up`, as they are written in the file.
    """

    def __init__(self, **variables: str) -> None:
        self.variables = variables
        self.config: dict[str, Any] = {}
        self.read()

    def run(self, *words: str, inputs: bytes | None = None, **variables: str) -> str:
        told = {**self.variables, **variables, "COMPOSE_PROJECT_NAME": PROJECT}
        return command(sys.executable, "-m", "podman_compose", *words, inputs=inputs, **told)

    def read(self) -> None:
        import yaml  # brought by podman-compose

        profiles = [
            word for name in ("viewer", "sqlite", "dask", "monitoring") for word in ("--profile", name)
        ]
        self.config = yaml.safe_load(self.run(*profiles, "config"))

    def container(self, service: str, number: int = 1) -> str:
        return f"{PROJECT}_{service}_{number}"

    def up(self, *services: str, **scale: int) -> None:
        """Start services after what they depend on, as ``docker compose up -d`` does."""
        for service in self._in_order(services):
            count = scale.get(service, 1)
            self._remove_outdated(service)
            self._remove_surplus(service, count)
            if self._state(service).get("Running") and count == 1:
                continue
            words = ["--scale", f"{service}={count}"] if count > 1 else []
            profiles = [
                w
                for name in self.config["services"][service].get("profiles", ())
                for w in ("--profile", name)
            ]
            self.run(*profiles, "up", "-d", "--no-deps", "--no-build", *words, service)
            self._wait(service)

    def stop(self, *services: str) -> None:
        """All containers of these, of which podman-compose knows the first alone."""
        for service in services:
            command("podman", "stop", "-t", "30", *self._containers(service))

    def down(self) -> None:
        """Containers, networks and volumes of the project are gone afterwards."""
        for service in self.config["services"]:
            self._remove_surplus(service, 1)
        self.run("down", "-v")
        for kind in ("container", "volume"):
            words = ["ls", "-q", "--filter", f"label=io.podman.compose.project={PROJECT}"]
            left = command("podman", kind, *words, *(["-a"] if kind == "container" else []))
            if left.strip():
                raise Failed(f"down -v left a {kind}: {left}")

    def _remove_surplus(self, service: str, count: int) -> None:
        for name in self._containers(service):
            if int(name.rpartition("_")[2]) > count:
                command("podman", "rm", "-f", "-t", "20", name)

    def _containers(self, service: str) -> list[str]:
        """Names of a service's containers, whether they run or not."""
        words = ["--filter", f"label=io.podman.compose.project={PROJECT}", "--format", "{{.Names}}"]
        names = command("podman", "ps", "-a", *words).split()
        return [name for name in names if re.fullmatch(rf"{PROJECT}_{service}_\d+", name)]

    def _remove_outdated(self, service: str) -> None:
        """As an engine does: a container of another image than its name now stands for is made anew."""
        name, image = self.container(service), self.config["services"][service]["image"]
        try:
            held = command("podman", "inspect", "--type", "container", "--format", "{{.Image}}", name)
        except Failed:
            return
        if held != command("podman", "image", "inspect", "--format", "{{.Id}}", image):
            command("podman", "rm", "-f", "--depend", "-t", "20", name)

    def _in_order(self, services: tuple[str, ...]) -> list[str]:
        order: list[str] = []

        def add(name: str) -> None:
            for before in self.config["services"][name].get("depends_on", {}):
                add(before)
            if name not in order:
                order.append(name)

        for name in services:
            add(name)
        return order

    def _wait(self, service: str) -> None:
        """Until it has ended well, if it is one that ends, or is healthy."""
        told = self.config["services"][service]
        if told.get("restart") == "no":
            wait_for(f"{service} ends", lambda: self._state(service).get("Status") == "exited")
            if self._state(service)["ExitCode"]:
                raise Failed(f"{service}: {self.logs(service)}")
        elif "healthcheck" in told:
            self.wait_healthy(service)

    def wait_healthy(self, service: str) -> None:
        wait_for(
            f"{service} is healthy",
            lambda: command("podman", "healthcheck", "run", self.container(service)) is not None,
        )

    def _state(self, service: str) -> dict[str, Any]:
        try:
            (told,) = json.loads(command("podman", "inspect", "--type", "container", self.container(service)))
        except Failed:
            return {}
        state: dict[str, Any] = told["State"]
        return state

    def logs(self, service: str) -> str:
        done = subprocess.run(["podman", "logs", self.container(service)], capture_output=True, check=False)
        return (done.stdout + done.stderr).decode(errors="replace")[-3000:]
