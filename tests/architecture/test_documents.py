"""What the architecture page says is where it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/architecture.md").read_text()
#: Where a path on the page may begin.
HOMES = (
    "service",
    "service/graspdb_service",
    "clients",
    "simworker/graspdb_simworker",
    ".",
)


@pytest.mark.parametrize(
    "name", sorted(set(re.findall(r"`([a-z_]+(?:/[a-z_]+)*/?[a-z_]*\.py|[a-z_]+/[a-z_/]+)`", PAGE)))
)
def test_a_path_on_the_page_exists(name: str) -> None:
    assert any((ROOT / home / name).exists() for home in HOMES), f"docs/architecture.md names {name}"


def test_each_way_has_at_most_eight_steps() -> None:
    ways = re.findall(r"^## The way of .*?(?=^## )", PAGE, re.MULTILINE | re.DOTALL)
    assert len(ways) == 3
    assert all(3 <= len(re.findall(r"^\d+\. ", way, re.MULTILINE)) <= 8 for way in ways)


def test_the_readme_links_to_it() -> None:
    assert "(docs/architecture.md)" in (ROOT / "README.md").read_text()
