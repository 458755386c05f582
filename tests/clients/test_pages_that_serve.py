"""What the pages tell to type that serves until it is stopped, or takes hours: typed, and asked for less."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import trustme

from graspdb import Client
from pages import DOCS, ROOT, blocks, going_on, typed
from real_processes import Process, free_port, running, wait_for

VIEWER = DOCS / "guide" / "viewer.md"
EXPERIMENTS = DOCS / "experiments.md"


def test_a_lab_server_with_keys(empty_postgres_url: str, tmp_path: Path) -> None:
    ((_, block),) = blocks(DOCS / "security.md", "bash")
    typed(f"graspdb-server migrate --database-url {empty_postgres_url}", tmp_path)
    authority = trustme.CA()
    certificate = authority.issue_cert("127.0.0.1")
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    certificate.private_key_pem.write_to_path(tmp_path / "lab.key")
    for pem in certificate.cert_chain_pems:
        pem.write_to_path(tmp_path / "lab.pem", append=True)
    port = free_port()
    url, trusted = f"https://127.0.0.1:{port}", {"SSL_CERT_FILE": str(tmp_path / "ca.pem")}
    where, created, served, shown, limited = block.splitlines()
    where = where.replace("postgresql://graspdb@db/graspdb", empty_postgres_url)
    (key,) = re.findall(r"graspdb_\S+", typed(f"{where}\n{created}", tmp_path))
    verify = ssl.create_default_context(cafile=trusted["SSL_CERT_FILE"])
    stored = {"GRASPDB_DATABASE_URL": empty_postgres_url}
    with going_on(f"{served} --port {port}", tmp_path, f"{url}/readyz", verify=verify, **stored):
        shown = shown.replace("graspdb_...", key)
        said = typed(f"{shown}\n{limited}", tmp_path, GRASPDB_URL=url, **trusted)
        (arm,) = re.findall(r"graspdb_\S+", said)
        with httpx.Client(base_url=url, verify=verify, headers={"Authorization": f"Bearer {arm}"}) as http:
            assert http.get("/objects").status_code == 200
            assert http.get("/objects/other").status_code == 403
            assert http.get("/keys").status_code == 403


@contextmanager
def _nginx(folder: Path, location: str) -> Iterator[str]:
    """A proxy with this location; its address."""
    program = shutil.which("nginx", path="/usr/sbin:/sbin:/usr/bin:/bin:/usr/local/sbin")
    assert program, "nginx is missing: sudo apt-get install nginx-light"
    port = free_port()
    kept = " ".join(
        f"{kind}_temp_path {folder}/{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (folder / "nginx.conf").write_text(
        f"{'user root; ' if os.geteuid() == 0 else ''}pid {folder}/pid; daemon off; events {{}}\n"
        f"http {{ access_log off; {kept} server {{ listen 127.0.0.1:{port};\n{location}}} }}\n"
    )
    command = [program, "-p", str(folder), "-e", str(folder / "log"), "-c", str(folder / "nginx.conf")]
    nginx = subprocess.Popen(command)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        nginx.terminate()
        nginx.wait(30)


def test_a_proxy_that_serves_it_under_a_prefix(tmp_path: Path) -> None:
    page = DOCS / "security.md"
    ((_, location),) = blocks(page, "nginx")
    (served,) = re.findall(r"with `(graspdb-server serve [^`]+)`", page.read_text(encoding="utf-8"))
    port = free_port()
    stored = {"GRASPDB_DATABASE_URL": f"sqlite:///{tmp_path}/graspdb.sqlite"}
    with (
        going_on(f"{served} --port {port}", tmp_path, f"http://127.0.0.1:{port}/readyz", **stored),
        _nginx(tmp_path, location.replace("8000", str(port))) as proxy,
    ):
        wait_for("the proxy answers", lambda: httpx.get(f"{proxy}/graspdb/livez").is_success)
        with Client(f"{proxy}/graspdb") as db:
            mug = db.add_example("mug")
            assert mug.info.id in [item.id for item in db.objects.list()]
        told = httpx.get(f"{proxy}/graspdb/openapi.json").json()
        assert told["servers"] == [{"url": "/graspdb"}]


def test_a_viewer_of_a_lab_service(service_url: str, tmp_path: Path) -> None:
    ((_, block),) = blocks(VIEWER, "bash")
    lines = [line for line in block.splitlines() if " view mug" in line]
    here, there, *_ = (line for line in lines if "--robot" not in line)
    for command in (here, there.replace("http://lab:8000", service_url)):
        port = free_port()
        command = command.partition("#")[0].replace("8090", str(port))
        if "--port" not in command:
            command += f" --port {port}"
        with going_on(command, tmp_path, f"http://127.0.0.1:{port}/", GRASPDB_URL=service_url):
            pass


@pytest.mark.long
@pytest.mark.timeout(1_800)
def test_the_demo_in_the_viewer(tmp_path: Path) -> None:
    ((_, block),) = blocks(VIEWER, "bash")
    command = shlex.split(block.splitlines()[-1], comments=True)
    assert command == ["graspdb", "demo", "--view"]
    demo = Process(tmp_path / "demo.log", *command, cwd=tmp_path)
    with running(demo):
        found: list[str] = []

        def shown() -> bool:
            assert demo.is_running(), demo.log()
            found[:] = re.findall(r"Look at (http://\S+) in a browser", demo.log())
            return bool(found) and httpx.get(found[0], follow_redirects=True).is_success

        wait_for("the viewer answers", shown, seconds=1_500)
        # As a shell tells that it was asked to end.
        assert demo.stop() == 128 + signal.SIGTERM


@pytest.mark.long
@pytest.mark.timeout(3_600)
def test_the_experiments_on_a_small_part_of_their_grids(tmp_path: Path) -> None:
    grids, report, again, matching = (block for _, block in blocks(EXPERIMENTS, "bash"))
    port = free_port()
    serving, *rest = grids.replace("8123", str(port)).splitlines()
    url = f"http://127.0.0.1:{port}"
    here = {"GRASPDB_URL": url}

    def small(block: str, **fewer: str) -> str:
        for asked, less in fewer.items():
            assert asked in block
            block = block.replace(asked, less)
        return block.replace("tests/benchmarks", str(ROOT / "tests" / "benchmarks"))

    with going_on(serving.removesuffix("&"), tmp_path, f"{url}/readyz"):
        rows = typed(small("\n".join(rest), **{"0.02": "0.02 --max-poses 4000"}), tmp_path, **here)
        assert [row.split(" | ")[0] for row in rows.splitlines() if row.startswith("| screwdriver")]
        typed(small(report, OBJECT="screwdriver"), tmp_path, **here)
        worker, asked = again.splitlines()
        with running(Process(tmp_path / "worker.log", *shlex.split(worker.removesuffix("&")), **here)):
            fewer = {"--successes 1000 3000 300": "screwdriver --successes 60 --count 20"}
            said = typed(small(asked, **fewer), tmp_path, **here)
            assert len(re.findall(r"^\| screwdriver", said, re.MULTILINE)) == 4
            worker_too, asked = matching.splitlines()
            assert worker_too == worker
            fewer = {"_matching.py": "_matching.py screwdriver --learned 150 --judged 250 --draws 200"}
            assert "| screwdriver |" in typed(small(asked, **fewer), tmp_path, **here)


@pytest.mark.long
@pytest.mark.timeout(3_600)
def test_the_speed_of_densities(tmp_path: Path) -> None:
    ((_, block),) = blocks(DOCS / "performance.md", "bash")
    figure = tmp_path / "density-speed.svg"
    (command,) = block.replace("docs/figures/density-speed.svg", str(figure)).splitlines()
    assert "calibration" in typed(command.replace("tests/", f"{ROOT}/tests/"), tmp_path)
    assert figure.stat().st_size > 10_000
