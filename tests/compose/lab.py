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
PROFILES = [word for name in ("viewer", "sqlite", "dask", "monitoring") for word in ("--profile", name)]

#: Hands each question on to another name server, and its answer back.
NAME_SERVER = """
import socket, sys
here = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
here.bind(("127.0.0.11", 53))
while True:
    question, asker = here.recvfrom(4096)
    there = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    there.settimeout(2)
    there.sendto(question, (sys.argv[1], 53))
    try:
        here.sendto(there.recv(4096), asker)
    except OSError:
        pass
    there.close()
"""


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
    """The project of ``compose.yaml`` and what is laid over it, with variables of its own.

    podman here has neither systemd, which would look at health, nor the waiting for it: conditions of
    ``depends_on`` are waited for by :meth:`up`, as they are written in the file.
    """

    def __init__(self, *files: str, **variables: str) -> None:
        self.variables = variables
        self.files = [word for file in files for word in ("-f", file)]
        import yaml  # brought by podman-compose

        self.config: dict[str, Any] = yaml.safe_load(self.run(*PROFILES, "config"))

    def run(self, *words: str, inputs: bytes | None = None, **variables: str) -> str:
        told = {**self.variables, **variables, "COMPOSE_PROJECT_NAME": PROJECT}
        return command(sys.executable, "-m", "podman_compose", *self.files, *words, inputs=inputs, **told)

    def builds(self) -> dict[str, str]:
        """The Dockerfile of each image that the files have built."""
        built = (each for each in self.config["services"].values() if "build" in each)
        return {each["image"]: each["build"]["dockerfile"] for each in built}

    def default(self, *profiles: str) -> list[str]:
        """The services that ``up`` starts when it names none."""
        listed = self.config["services"].items()
        wanted = {None, *profiles}
        return [name for name, told in listed if wanted & set(told.get("profiles") or [None])]

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
            for number in range(1, count + 1):
                self._wait(service, number)

    def stop(self, *services: str) -> None:
        """All containers of these, of which podman-compose knows the first alone."""
        for service in services:
            command("podman", "stop", "-t", "30", *self._containers(service))

    def down(self) -> None:
        """Containers, networks and volumes of the project are gone afterwards."""
        for service in self.config["services"]:
            self._remove_surplus(service, 1)
        self.run(*PROFILES, "down", "-v")
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

    def _wait(self, service: str, number: int) -> None:
        """Until it has ended well, if it is one that ends, or is healthy."""
        told = self.config["services"][service]
        if told.get("restart") == "no":
            wait_for(f"{service} ends", lambda: self._state(service).get("Status") == "exited")
            if self._state(service)["ExitCode"]:
                raise Failed(f"{service}: {self.logs(service)}")
        elif "healthcheck" in told:
            self.wait_healthy(service, number)

    def wait_healthy(self, service: str, number: int = 1) -> None:
        wait_for(
            f"{service} is healthy",
            lambda: command("podman", "healthcheck", "run", self.container(service, number)) is not None,
        )

    def address(self, service: str, number: int = 1) -> str:
        """Of a container in the project's network, from which this process is reached, and reaches it."""
        form = "{{range .NetworkSettings.Networks}}{{.IPAddress}}{{end}}"
        return command("podman", "inspect", "--format", form, self.container(service, number)).strip()

    def name_server(self, service: str, number: int = 1) -> subprocess.Popen[bytes]:
        """Docker's name server at 127.0.0.11 of a container: podman has one at another address."""
        name = self.container(service, number)
        pid = command("podman", "inspect", "--format", "{{.State.Pid}}", name).strip()
        told = re.search(
            r"^nameserver (\S+)", command("podman", "exec", name, "cat", "/etc/resolv.conf"), re.M
        )
        if not told:
            raise Failed(f"{name} has no name server")
        words = ("nsenter", "--target", pid, "--net", sys.executable, "-c", NAME_SERVER, told[1])
        return subprocess.Popen(words)

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
