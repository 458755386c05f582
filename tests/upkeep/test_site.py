"""The site of docs/: built, without a link that leads nowhere, and read from files without a network."""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from viewer_tab import chromium

ROOT = Path(__file__).resolve().parents[2]


def _run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "NO_COLOR": "1"}
    words = (sys.executable, *words)
    return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the site is made of."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copy(ROOT / "zensical.toml", folder)
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=shutil.ignore_patterns("reference"))
    (folder / "clients").symlink_to(ROOT / "clients")
    return folder


@pytest.fixture(scope="module")
def site(checkout: Path) -> Path:
    done = _run(checkout, "docs/make_site.py")
    assert done.returncode == 0, done.stdout + done.stderr
    return checkout / "site"


def test_every_page_is_in_the_site_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = {page.relative_to(ROOT / "docs").with_suffix(".html") for page in (ROOT / "docs").rglob("*.md")}
    assert pages <= {page.relative_to(site) for page in site.rglob("*.html")}
    for page in pages:
        text = (site / page).read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|link|iframe)\b[^>]*?(?:src|href)=\"?(https?:[^\" >]+)", text)
        assert not loaded, (page, loaded)


def test_the_reference_has_routes_commands_and_classes(site: Path) -> None:
    found = {
        name: (site / "reference" / f"{name}.html").read_text("utf-8") for name in ("http", "cli", "python")
    }
    for name, words in {
        "http": ("/best-grasp", "approach_cone_deg", "GripperProfile"),
        "cli": (
            "graspdb best-grasp",
            "--approach-cone-deg",
            "graspdb-server backup",
            "graspdb-simworker run",
        ),
        "python": ("best_grasp", "calibrated_for", "proposal_density", "Infeasible"),
    }.items():
        missing = [word for word in words if word not in found[name]]
        assert not missing, (name, missing)


def test_a_link_that_leads_nowhere_ends_the_build(site: Path, checkout: Path) -> None:
    page = checkout / "docs" / "index.md"
    kept = page.read_text("utf-8")
    page.write_text(f"{kept}\n[x](nowhere.md) and [y](guide/frames.md#nowhere)\n", "utf-8")
    done = _run(checkout, "-m", "zensical", "build", "--strict")
    page.write_text(kept, "utf-8")
    assert done.returncode != 0
    assert "2 issues found" in done.stdout + done.stderr


@pytest.mark.browser
def test_it_is_read_from_files_and_searched_from_a_server(site: Path) -> None:
    """Without a network either way; a browser lets no page of a file read the index of the search."""
    handler = functools.partial(SimpleHTTPRequestHandler, directory=str(site))
    with chromium() as browser, ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(urlsplit(request.url).netloc))
        page.goto((site / "index.html").as_uri())
        page.get_by_role("link", name="What the numbers say").first.click()
        page.get_by_text("A grasp comes with numbers").wait_for()
        page.goto((site / "guide" / "densities.html").as_uri())
        assert page.evaluate("document.images.length > 0")
        assert page.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
        home = f"127.0.0.1:{server.server_port}"
        page.goto(f"http://{home}/index.html")
        page.get_by_role("button", name="Search").first.click()
        page.wait_for_timeout(500)
        page.keyboard.type("workspace", delay=20)
        page.get_by_text("GET /objects/{id}/best-grasp").first.wait_for()
        server.shutdown()
        assert set(asked) <= {"", home}
