"""Pictures over HTTP: of objects and grasps, tagged by what they show, and refused in words."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from PIL import Image

Make, Post = Callable[..., str], Callable[..., dict[str, Any]]
SMALL = {"width": 64, "height": 48}
GRASP = {"position": "0,0,0.045", "quaternion_xyzw": "1,0,0,0"}


def _picture(http: httpx.Client, slug: str, **params: Any) -> httpx.Response:
    return http.get(f"/objects/{slug}/picture", params={**SMALL, **params})


def test_an_object_and_a_grasp_are_drawn(
    sqlite_http: httpx.Client, make_object: Make, put_box: Any, post: Post, two_clusters: Any
) -> None:
    slug = make_object(sqlite_http, "drawn")
    refused = _picture(sqlite_http, slug)
    assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (409, "mesh-missing")
    put_box(sqlite_http, slug)
    bare = _picture(sqlite_http, slug)
    assert (bare.status_code, bare.headers["content-type"]) == (200, "image/png")
    with Image.open(io.BytesIO(bare.content)) as image:
        assert (image.format, image.size) == ("PNG", (64, 48))
    unknown = _picture(sqlite_http, slug, **GRASP)
    assert unknown.json()["type"].endswith("gripper-unknown")
    seen = {bare.content}
    for more in ({"gripper": "pg70"}, {"gripper": "panda"}, {"gripper": "panda", "opening_m": 0.08}):
        seen.add(_picture(sqlite_http, slug, **GRASP, **more).content)
    seen.add(_picture(sqlite_http, slug, azimuth_deg=100).content)
    assert len(seen) == 5, "each shows something else"
    # The base's pose says the same grasp.
    base = {"position": "0,0,0.1484", "quaternion_xyzw": "1,0,0,0", "gripper": "panda", "frame": "base"}
    answer = _picture(sqlite_http, slug, **base)
    assert answer.status_code == 200, answer.text


def test_a_tag_lives_as_long_as_what_is_shown(
    sqlite_http: httpx.Client, make_object: Make, put_box: Any, post: Post, two_clusters: Any
) -> None:
    slug = make_object(sqlite_http, "tagged-picture")
    put_box(sqlite_http, slug)
    tag = _picture(sqlite_http, slug).headers["etag"]
    post(sqlite_http, slug, two_clusters, gripper="pg70")

    def again(**params: Any) -> int:
        sent = {"If-None-Match": tag}
        return sqlite_http.get(
            f"/objects/{slug}/picture", params={**SMALL, **params}, headers=sent
        ).status_code

    assert again() == 304, "trials change no picture"
    assert again(height=49) == 200
    held = _picture(sqlite_http, slug, **GRASP)
    assert held.status_code == 200, "the gripper of the trials is drawn"
    tag = held.headers["etag"]
    assert again(**GRASP) == 304
    assert again(**GRASP, opening_m=0.06) == 200
    sqlite_http.delete(f"/objects/{slug}")
    make_object(sqlite_http, slug)
    put_box(sqlite_http, slug, (0.03, 0.03, 0.03))
    assert again() == 200


def test_what_cannot_be_drawn_is_refused(
    sqlite_http: httpx.Client, make_object: Make, put_box: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    slug = make_object(sqlite_http, "undrawable")
    put_box(sqlite_http, slug)
    for params, said in (
        ({"position": "0,0,0"}, "give both"),
        ({"opening_m": 0.01}, "opening_m is of a grasp"),
        ({**GRASP, "gripper": "pg70", "opening_m": 0.5}, "pg70 opens"),
        ({"width": 5_000}, "1280"),
        ({"elevation_deg": 90}, "85"),
    ):
        answer = _picture(sqlite_http, slug, **params)
        assert answer.status_code == 422, answer.text
        assert said in answer.text
    assert _picture(sqlite_http, "nothing").status_code == 404
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "embreex" else find(name, *more)
    )
    answer = _picture(sqlite_http, slug)
    assert (answer.status_code, answer.json()["type"].rpartition(":")[2]) == (406, "pictures-not-installed")
    assert "graspdb[pictures]" in answer.json()["title"]
