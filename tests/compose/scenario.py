"""What a lab does with ``compose.yaml``, from the first start on; every command of the guide is run."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import httpx

from graspdb import Client
from lab import ROOT, Compose, Failed, command, say, wait_for
from monitoring import Prometheus

URL = "http://127.0.0.1:8000"
#: What URLs, shells, quotes and compose's own variables would each take for something else.
STRANGE = "it's %41 p@ss:w/ö?r#d\\&$HOME ${X:-y} $$ `id` {}\"; -- "
#: A grasp of the mug in seventy succeeds.
POSES = 4_000
#: What a lab gets by itself and tests have under another name.
ELSEWHERE = ("git pull",)
#: Services of whose image nothing can be made from packages.
LACKING = {"grafana"}


def guide() -> dict[str, list[str]]:
    """The commands of the guide's page, by the bold words of the paragraph before."""
    text = (ROOT / "docs/guide/compose.md").read_text("utf-8")
    found: dict[str, list[str]] = {}
    paragraph = r"^\*\*([\w ]+)(?:(?!^\*\*).)*?^```sh\n(.*?)^```"
    for name, block in re.findall(paragraph, text, re.MULTILINE | re.DOTALL):
        lines = block.replace("\\\n", " ").splitlines()
        found[name] = [line for line in lines if line.strip() and not line.startswith("#")]
    return found


class Scenario:
    """The steps, in order; each leaves everything as a lab would have it."""

    def __init__(self, newer: dict[str, str]) -> None:
        # Each process of a worker compiles at its first start: two of them have enough to do here.
        self.compose = Compose(GRASPDB_WORKER_PROCESSES="1")
        self.newer = newer
        self.guide = guide()
        self.done: list[str] = []
        self.url = URL
        self.sweep = ""
        self.made = tempfile.TemporaryDirectory(prefix="graspdb-compose-")
        self.folder = Path(self.made.name)

    # --- the guide's commands

    def follow(self, name: str, **variables: str) -> list[str]:
        """Run the commands of a paragraph as they stand there; what each printed."""
        said = []
        for line in self.guide.pop(name):
            say(f"  $ {line}")
            said.append(self._type(line, variables))
        return said

    def _type(self, line: str, variables: dict[str, str]) -> str:
        line = line.partition("  #")[0].strip()
        if line in ELSEWHERE:
            return ""
        printed = subprocess.run(
            ["sh", "-c", f"printf '%s\\0' {line}"],
            cwd=self.folder,
            env={**os.environ, "PWD": str(self.folder), **variables},
            stdout=subprocess.PIPE,
            check=True,
        )
        words = printed.stdout.decode().split("\0")[:-1]
        assert words[:2] == ["docker", "compose"], line
        return self._compose(words[2:])

    def _compose(self, words: list[str]) -> str:
        """What the engine does at a command, by podman-compose."""
        options: dict[str, list[str]] = {"-f": [], "--profile": []}
        while words[0] in options:
            option, value, *words = words
            options[option].append(value)
        if options["-f"]:
            self.compose = Compose(*options["-f"], **self.compose.variables)
        verb, *rest = words
        if verb == "up":
            scale = dict(each.split("=") for each in _after(rest, "--scale"))
            named = [w for w in rest if not w.startswith("-") and "=" not in w]
            wanted = named or self.compose.default(*options["--profile"])
            for lacking in sorted(LACKING & {*wanted}):
                say(f"  (not {lacking}, whose image only a registry has)")
            wanted = [name for name in wanted if name not in LACKING]
            self.compose.up(*wanted, **{name: int(count) for name, count in scale.items()})
            return ""
        if verb == "build":  # they are ready
            for image, id in self.newer.items():
                command("podman", "tag", id, image)
            return ""
        if verb == "stop":
            self.compose.stop(*rest)
            return ""
        if verb == "exec":
            return self.compose.run("exec", "-T", *rest)
        if verb == "run":
            first = next(w for w in rest if w in self.compose.config["services"])
            place = rest.index(first)
            self.compose.up(*self.compose.config["services"][first].get("depends_on", ()))
            return self.compose.run("run", "--no-deps", "-T", *rest[:place], first, *rest[place + 1 :])
        return self.compose.run(verb, *rest)

    # --- what has to hold

    def counts(self) -> dict[str, Any]:
        with Client(self.url) as db:
            listed = [item.info for item in db.objects.list()]
        return {info.id: (info.trials, dict(info.outcomes), info.revision) for info in listed}

    def steps(self) -> None:
        for step in (
            self.first_start,
            self.killed_worker,
            self.answers_of_images,
            self.password,
            self.database_restarts,
            self.update,
            self.contained,
            self.monitoring,
            self.viewer,
            self.dask,
            self.move,
            self.replicas,
            self.one_container,
        ):
            say(step.__name__.replace("_", " "))
            step()
            self.done.append(step.__name__.replace("_", " "))
        assert not self.guide, f"commands that no step ran: {self.guide}"

    def first_start(self) -> None:
        """Nothing is prepared; an object, and a sweep in real physics through which a worker is killed."""
        self.follow("Starting")
        with Client(URL) as db:
            self.sweep = db.add_example("mug").sweep(max_poses=POSES, chunk_poses=POSES // 8).id

    def killed_worker(self) -> None:
        """In the midst of a chunk, which is given out again: no pose is lost, and there is a best grasp."""
        wait_for("the worker has a chunk", lambda: self.leased("simworker"))
        self.crash("simworker")
        with Client(URL) as db:
            sweep = db.sweeps.get(self.sweep).wait()
            told = sweep.info
            assert (told.state, told.poses_done, told.chunks_failed) == ("done", POSES, 0), told
            assert sum(told.outcomes.values()) == POSES, told
            best = db.objects.get("mug").best_grasp()
            say(f"  of {POSES} poses {told.outcomes}, the best grasp of the mug at {best.position}")

    def leased(self, service: str) -> int:
        """How many chunks the first container of a worker has in hand."""
        host = command("podman", "inspect", "--format", "{{.Id}}", self.compose.container(service))[:12]
        workers = httpx.get(f"{URL}/workers", timeout=60).json()["items"]
        return sum(each["jobs_leased"] for each in workers if each["worker"].startswith(host))

    def answers_of_images(self) -> None:
        for path, kind, start in [
            ("/objects/mug/reports/projection", "image/png", b"\x89PNG"),
            ("/objects/mug/trials", "application/vnd.apache.arrow.stream", b"\xff\xff\xff\xff"),
        ]:
            answer = wait_for(path, lambda path=path, kind=kind: self.answer(path, kind))
            assert answer.headers["content-type"] == kind
            assert answer.content.startswith(start)

    def answer(self, path: str, kind: str) -> httpx.Response | None:
        """None while it is computed."""
        found = httpx.get(f"{URL}{path}", headers={"Accept": kind}, timeout=120)
        assert found.status_code in (200, 202), found.text
        return found if found.status_code == 200 else None

    def crash(self, service: str) -> None:
        """kill -9 of a container's first process: the restart policy brings another."""
        name = self.compose.container(service)
        pid = int(command("podman", "inspect", "--format", "{{.State.Pid}}", name))
        os.kill(pid, signal.SIGKILL)

        def runs_again() -> bool:
            now = command("podman", "inspect", "--format", "{{.State.Running}} {{.State.Pid}}", name).split()
            return now[0] == "true" and int(now[1]) not in (0, pid)

        wait_for(f"{service} runs again", runs_again)

    def database_restarts(self) -> None:
        """Stopped and started, and killed: the service connects anew, with the password of odd characters."""
        before = self.counts()
        self.compose.run("restart", "db")
        self.ready()
        assert self.counts() == before
        self.crash("db")
        self.ready()
        assert self.counts() == before

    def ready(self) -> None:
        self.compose.wait_healthy("db")
        wait_for("the service is ready", lambda: httpx.get(f"{URL}/readyz").is_success)

    def password(self) -> None:
        """Changed to one of odd characters, while the service goes on: it shows it when it connects anew."""
        old = command("podman", "exec", self.compose.container("service"), "cat", "/run/graspdb/password")
        before = self.counts()
        self.follow("Passwords", NEW_PASSWORD=STRANGE)
        now = command("podman", "exec", self.compose.container("service"), "cat", "/run/graspdb/password")
        assert now == STRANGE, now
        assert self.connects(STRANGE)
        assert not self.connects(old)
        assert self.counts() == before

    def connects(self, password: str) -> bool:
        words = ["psql", "-X", "-h", "db", "-U", "graspdb", "-d", "graspdb", "-c", "SELECT 1"]
        done = subprocess.run(
            ["podman", "exec", "--env", "PGPASSWORD", self.compose.container("db"), *words],
            env={**os.environ, "PGPASSWORD": password},
            capture_output=True,
            check=False,
        )
        return done.returncode == 0

    def update(self) -> None:
        before, image = self.counts(), self.image()
        self.follow("Backing up")
        backup = self.folder / "graspdb.backup"
        assert backup.stat().st_size > 1000
        backup.unlink()
        self.follow("Updating")
        self.ready()
        assert self.image() != image
        assert self.counts() == before

    def image(self) -> str:
        return command("podman", "inspect", "--format", "{{.Image}}", self.compose.container("service"))

    def contained(self) -> None:
        """No container runs as root, writes beside its volumes, or has capabilities."""
        for service in ("db", "service", "simworker"):
            name = self.compose.container(service)
            pid = command("podman", "inspect", "--format", "{{.State.Pid}}", name).strip()
            status = Path(f"/proc/{pid}/status").read_text()
            assert re.search(r"^Uid:\s+(?!0\s)", status, re.MULTILINE), service
            assert re.search(r"^CapBnd:\s+0+$", status, re.MULTILINE), service
            assert re.search(r"^NoNewPrivs:\s+1$", status, re.MULTILINE), service
            # As root, whose the folder is: nothing but the file system being read-only is in the way.
            words = ["podman", "exec", "--user", "0", name, "sh", "-c", "echo > /opt/written"]
            said = subprocess.run(words, capture_output=True, check=False).stderr.decode()
            assert "read-only file system" in said.lower(), (service, said)

    def move(self) -> None:
        """To a host that has nothing but the backup."""
        before = self.counts()
        self.follow("Moving to another host")
        assert (self.folder / "graspdb.backup").stat().st_size > 1000
        self.compose.down()
        self.follow("On the new host")
        self.ready()
        assert self.counts() == before
        with Client(URL) as db:
            assert db.objects.get("mug").best_grasp().density > 0

    # --- profiles, replicas, and the one container

    def monitoring(self) -> None:
        """Rules in force, every replica scraped, and every panel of the dashboard has its numbers."""
        password = self.follow("Monitoring")[-1]
        assert len(password) > 20, password
        found = Prometheus(self.compose)
        found.check_files()
        found.wait_scraped(replicas=1)
        httpx.get(f"{URL}/objects/none")  # so that there is an answer that is no success
        found.ask_rules()
        found.ask_dashboard()
        found.reached_as_grafana_would()
        self.compose.stop("prometheus")

    def viewer(self) -> None:
        self.follow("Viewer")
        page = httpx.get("http://127.0.0.1:8080", timeout=60)
        assert page.is_success
        assert "<html" in page.text.lower()
        self.compose.stop("viewer")

    def dask(self) -> None:
        """Chunks are simulated by the cluster's workers while no worker of the lab's own runs."""
        self.follow("Dask")
        self.compose.stop("simworker")
        with Client(URL) as db:
            told = db.objects.get("mug").sweep(max_poses=200, chunk_poses=50).wait().info
        assert (told.state, told.poses_done, told.chunks_failed) == ("done", 200, 0), told
        self.compose.stop("dask-simworker", "dask-worker", "dask-scheduler")

    def replicas(self) -> None:
        """Any of them answers what another was told, at once; one that is killed is not missed."""
        before = self.counts()
        self.follow("Replicas")
        servers = self.compose.name_server("nginx")
        try:
            wait_for("nginx passes on", lambda: httpx.get(f"{URL}/readyz").is_success)
            assert self.counts() == before
            every = [f"http://{self.compose.address('service', n)}:8000" for n in (1, 2, 3)]
            named = {"Host": "service:8000"}
            for number in range(12):
                told = {"id": f"box-{number}", "mass_kg": 0.1}
                httpx.post(f"{URL}/objects", json=told, timeout=60).raise_for_status()
                for each in every:
                    assert httpx.get(f"{each}/objects/box-{number}", headers=named, timeout=60).is_success
            counted = [httpx.get(f"{each}/metrics", headers=named).text for each in every]
            assert all('route="/objects",status="201"' in text for text in counted)
            command("podman", "kill", self.compose.container("service", 2))
            for number in range(12):
                assert httpx.get(f"{URL}/objects/box-{number}", timeout=60).is_success
        finally:
            servers.kill()
            servers.wait()

    def one_container(self) -> None:
        """The service on a SQLite file; a container that is made anew finds what the one before stored."""
        self.compose.down()
        kept = self.compose.variables
        # Nothing starts where anybody is let in without a word of it; then at another address and port.
        self.compose = Compose(**kept, GRASPDB_ADDRESS="0.0.0.0")
        said = ""
        try:
            self.compose.up("secrets")
        except Failed as error:
            said = str(error)
        assert "lets others in: say GRASPDB_AUTH" in said, said
        self.compose.down()
        self.compose = Compose(**kept, GRASPDB_ADDRESS="127.0.0.2", GRASPDB_PORT="8123")
        self.url = "http://127.0.0.2:8123"
        self.follow("One container")
        with Client(self.url) as db:
            made = db.add_example("mug")
            made.trials.add([[0, 0, 0.05, 1, 0, 0, 0]], [True], gripper="pg70", source="robot")
            assert made.best_grasp().density > 0
        before = self.counts()
        command("podman", "rm", "-f", "-t", "20", self.compose.container("sqlite"))
        self.compose.up("sqlite")
        assert self.counts() == before


def _after(words: list[str], option: str) -> list[str]:
    return [words[n + 1] for n, word in enumerate(words[:-1]) if word == option]
