"""Several replicas of the service over one PostgreSQL, and the nginx of ``deploy`` before them."""

from __future__ import annotations

import os
import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path

import httpx

from postgres_server import PostgresPrograms, PostgresServer
from real_processes import Process, free_port, wait_for

DEPLOY = Path(__file__).resolve().parents[2] / "deploy" / "nginx"


class ReplicaSet:
    """``count`` replicas that were started at once on an empty database, each of which migrated it first."""

    def __init__(self, folder: Path, programs: PostgresPrograms, count: int = 3, **settings: str) -> None:
        self._stack = ExitStack()
        folder.chmod(0o755)
        try:
            home = folder / "postgres"
            home.mkdir()
            self.postgres = PostgresServer(home, programs)
            self._stack.callback(self.postgres.stop)
            self.ports = [free_port() for _ in range(count)]
            self.urls = [f"http://127.0.0.1:{port}" for port in self.ports]
            told = {"GRASPDB_DATABASE_URL": self.postgres.url, "GRASPDB_LOG_LEVEL": "warning", **settings}
            self.migrations = [
                Process(folder / f"migrate-{n}.log", "graspdb-server", "migrate", **told)
                for n in range(count)
            ]
            self.replicas = [
                Process(folder / f"service-{n}.log", "graspdb-server", "serve", "--port", str(port), **told)
                for n, port in enumerate(self.ports)
            ]
            for process in (*self.migrations, *self.replicas):
                self._stack.callback(process.clean_up)
            for migration in self.migrations:
                migration.start()
            for migration, replica in zip(self.migrations, self.replicas, strict=True):
                assert migration.wait() == 0, migration.log()
                replica.start()
            for n in range(count):
                self.wait(n)
        except BaseException:
            self._stack.close()
            raise

    def wait(self, number: int) -> None:
        """Until a replica is ready."""

        def is_ready() -> bool:
            process = self.replicas[number]
            assert process.is_running(), f"replica {number} ended by itself:\n{process.log()}"
            return httpx.get(f"{self.urls[number]}/readyz").is_success

        wait_for(f"replica {number} is ready", is_ready)

    def begin_proxy(self, folder: Path) -> str:
        """The nginx of ``deploy`` before all replicas; its address."""
        program = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
        assert program, "nginx is missing: sudo apt-get install nginx-light"
        port = free_port()
        # As deployed, but for where it listens and keeps things.
        written = (DEPLOY / "nginx.conf").read_text()
        assert "listen 8080;" in written
        moved = written.replace("listen 8080;", f"listen 127.0.0.1:{port};").replace(" /tmp/", f" {folder}/")
        (folder / "nginx.conf").write_text(moved)
        named = " ".join(f"server 127.0.0.1:{port} max_fails=1 fail_timeout=2s;" for port in self.ports)
        (folder / "replicas.conf").write_text(f"upstream graspdb {{ {named} keepalive 64; }}\n")
        user = "user root; " if os.geteuid() == 0 else ""
        command = [program, "-p", str(folder), "-c", str(folder / "nginx.conf"), "-g"]
        with (folder / "nginx.log").open("w") as log:
            nginx = subprocess.Popen([*command, f"{user}daemon off;"], stderr=log)
        self._stack.callback(nginx.wait, 30)
        self._stack.callback(nginx.terminate)
        url = f"http://127.0.0.1:{port}"

        def answers() -> bool:
            assert nginx.poll() is None, (folder / "nginx.log").read_text()
            return httpx.get(f"{url}/livez").is_success

        wait_for("nginx answers", answers)
        return url

    def close(self) -> None:
        self._stack.close()
