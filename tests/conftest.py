"""What the tests share: real databases and a real server.

Every storage test runs on SQLite and on PostgreSQL. ``GRASPDB_TEST_POSTGRES_URL`` names a server to use
(its user must be allowed to create databases); otherwise one from a package is started for the session.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest
from hypothesis import settings

from graspdb_service.settings import Settings
from graspdb_service.storage import schema
from graspdb_service.storage.database import Database
from less_waiting import one_tls_context, read_once, serving
from postgres_server import PostgresPrograms, PostgresServer
from small_disk import Guard

# A machine's hiccup is no failure of the code: speed is measured in benchmarks.
# The same examples every time, so that a change is judged by what it changed; the variable HYPOTHESIS_RANDOM
# has new ones looked for.
settings.register_profile(
    "graspdb", deadline=None, derandomize=not os.environ.get("HYPOTHESIS_RANDOM"), print_blob=True
)
settings.load_profile("graspdb")

#: Seconds a test's client waits for an answer: a machine with other work is no failure of the code either.
PATIENCE_S = 240.0
_COMPILE = """
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.runtime.warmup import warm_up
warm_up(Compute(1))
"""


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the loops before several processes would each compile them all, with tests waiting for that."""
    # A developer's own service, key and settings are no part of any test.
    for name in [name for name in os.environ if name.startswith("GRASPDB_") and "_TEST_" not in name]:
        del os.environ[name]
    # The processes that tests start keep what they compile, as a user's do.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # The same question has the same answer while nothing is posted; what is learned has tests of its own.
    os.environ["GRASPDB_LEARNED_ESTIMATES"] = "false"
    one_tls_context()
    if getattr(session.config.option, "numprocesses", None):
        subprocess.run([sys.executable, "-c", _COMPILE], check=True)


@pytest.fixture(scope="session", autouse=True)
def _files_read_once() -> Iterator[None]:
    """The process that reads an untrusted file starts once for the same file, not in every test."""
    with pytest.MonkeyPatch.context() as patch:
        read_once(patch)
        yield


@pytest.fixture
def eventually() -> Callable[..., Any]:
    """``eventually(condition, seconds=60)`` waits until a condition holds; what it came to."""

    def wait(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
        deadline, pause = time.monotonic() + seconds, 0.02
        while not (found := condition()):
            assert time.monotonic() < deadline, "it never happened"
            time.sleep(pause)
            # What takes long is asked after less often: to ask may cost more than what is waited for.
            pause = min(1.3 * pause, 0.3)
        return found

    return wait


@pytest.fixture
def descendants(monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """``descendants()``: command lines of living processes that the test started, or these, and so on."""
    mark = f"TEST_MARK={uuid.uuid4().hex}"
    monkeypatch.setenv(*mark.split("="))

    def living() -> list[str]:
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if mark.encode() in (process / "environ").read_bytes().split(b"\0"):
                    found.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        return found

    return living


@contextmanager
def _temporary_folder(prefix: str) -> Iterator[Path]:
    """A folder that is gone afterwards, with whatever works in it, also when this process is killed."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    guard = Guard(folder)
    try:
        yield folder
    finally:
        guard.close()


@pytest.fixture(scope="session")
def postgres_programs() -> Iterator[PostgresPrograms]:
    """The programs of a PostgreSQL, for servers of the tests' own."""
    with _temporary_folder("graspdb-postgres-programs-") as folder:
        yield PostgresPrograms(folder)


@pytest.fixture(scope="session")
def postgres_server_url(request: pytest.FixtureRequest) -> Iterator[str]:
    """A PostgreSQL server that may be written to."""
    given = os.environ.get("GRASPDB_TEST_POSTGRES_URL")
    if given:
        yield given
        return
    programs: PostgresPrograms = request.getfixturevalue("postgres_programs")
    with _temporary_folder("graspdb-postgres-") as folder:
        server = PostgresServer(folder, programs)
        try:
            yield server.url
        finally:
            server.stop()


@pytest.fixture(scope="session")
def _postgres_template(postgres_server_url: str) -> Iterator[str]:
    """A migrated database that every test's own is copied from."""
    name = f"graspdb_template_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(postgres_server_url, autocommit=True) as admin:
        admin.execute(f"CREATE DATABASE {name}")
    database = Database(_named(postgres_server_url, name))
    schema.upgrade(database)
    database.dispose()
    yield name
    with psycopg.connect(postgres_server_url, autocommit=True) as admin:
        admin.execute(f"DROP DATABASE IF EXISTS {name} WITH (FORCE)")


@contextmanager
def _postgres_database(server: str, template: str) -> Iterator[str]:
    name = f"graspdb_{uuid.uuid4().hex[:16]}"
    with psycopg.connect(server, autocommit=True) as admin:
        admin.execute(f"CREATE DATABASE {name} TEMPLATE {template}")
    try:
        yield _named(server, name)
    finally:
        with psycopg.connect(server, autocommit=True) as admin:
            admin.execute(f"DROP DATABASE IF EXISTS {name} WITH (FORCE)")


def _named(server: str, name: str) -> str:
    return httpx.URL(server).copy_with(path=f"/{name}").__str__()


@pytest.fixture
def empty_sqlite_url(tmp_path: Path) -> str:
    """A SQLite database of this test's own, not yet created."""
    return f"sqlite:///{tmp_path / 'graspdb.sqlite'}"


@pytest.fixture(scope="session")
def _sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated database that every test's own is copied from."""
    path = tmp_path_factory.mktemp("template") / "graspdb.sqlite"
    database = Database(f"sqlite:///{path}")
    schema.upgrade(database)
    database.dispose()
    return path


@pytest.fixture
def sqlite_url(empty_sqlite_url: str, tmp_path: Path, _sqlite_template: Path) -> str:
    """A SQLite database of this test's own, migrated."""
    shutil.copyfile(_sqlite_template, tmp_path / "graspdb.sqlite")
    return empty_sqlite_url


@pytest.fixture
def empty_postgres_url(postgres_server_url: str) -> Iterator[str]:
    """A PostgreSQL database of this test's own, without a schema."""
    with _postgres_database(postgres_server_url, "template0") as url:
        yield url


@pytest.fixture
def postgres_url(postgres_server_url: str, _postgres_template: str) -> Iterator[str]:
    """A PostgreSQL database of this test's own, migrated."""
    with _postgres_database(postgres_server_url, _postgres_template) as url:
        yield url


@pytest.fixture(scope="module")
def postgres_module_url(postgres_server_url: str, _postgres_template: str) -> Iterator[str]:
    """As ``postgres_url``, for all tests of a module."""
    with _postgres_database(postgres_server_url, _postgres_template) as url:
        yield url


@pytest.fixture(params=["sqlite", "postgres"])
def database_url(request: pytest.FixtureRequest) -> str:
    """Each test twice: on SQLite and on PostgreSQL."""
    url: str = request.getfixturevalue(f"{request.param}_url")
    return url


Serve = Callable[..., str]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Start the service: ``serve(database_url, **settings)`` returns its address; several may run."""
    with ExitStack() as running:
        yield lambda url, **options: running.enter_context(serving(Settings(database_url=url, **options)))


@pytest.fixture(scope="module")
def serve_module() -> Iterator[Serve]:
    """As ``serve``, for all tests of a module."""
    with ExitStack() as running:
        yield lambda url, **options: running.enter_context(serving(Settings(database_url=url, **options)))


@pytest.fixture
def http(database_url: str, serve: Serve) -> Iterator[httpx.Client]:
    """A client of a real server over SQLite, then over PostgreSQL."""
    with httpx.Client(base_url=serve(database_url), timeout=PATIENCE_S) as client:
        yield client


@pytest.fixture
def sqlite_http(sqlite_url: str, serve: Serve) -> Iterator[httpx.Client]:
    """A client of a real server over SQLite: for what does not depend on the database."""
    with httpx.Client(base_url=serve(sqlite_url), timeout=PATIENCE_S) as client:
        yield client
