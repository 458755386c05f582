"""Bundles: what one GraspDB saves another takes in whole, and what is no bundle leaves nothing behind."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspdb import Client, wire
from graspdb.errors import GraspDBError
from graspdb.files.bundles import archive, loading, saving
from graspdb.files.bundles.archive import BundleProblem

MINE = {
    "max_opening_m": 0.1,
    "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.05},
    "palm_size_m": [0.1, 0.2, 0.05],
}
OWN = set(wire.TrialOut.model_fields) - {"seq", "revision", "batch", "answer", "sweep", "pose_index"}

pytestmark = pytest.mark.filterwarnings("ignore::graspdb.resources.trials.DoubtfulTrials")


@pytest.fixture
def here(sqlite_url: str, serve: Callable[..., str]) -> Iterator[Client]:
    with Client(serve(sqlite_url), retries=0) as client:
        yield client


@pytest.fixture
def there(postgres_url: str, serve: Callable[..., str]) -> Iterator[Client]:
    with Client(serve(postgres_url), retries=0) as client:
        yield client


def _box(*size: float) -> bytes:
    corners = [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)] * np.array(size)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    return b"\0" * 80 + struct.pack("<I", len(faces)) + rows


def _fill(db: Client, count: int = 60) -> None:
    """Two objects, a gripper in two versions, trials with all that they can have, a kernel."""
    db.grippers.create("mine", name="ours", **MINE)
    mug = db.objects.create(
        "mug",
        mesh=_box(40, 60, 100),
        unit="mm",
        scale=0.5,
        mass_kg=0.3,
        metadata={"shelf": 4},
        frames={"marker": [0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]},
    )
    rng = np.random.default_rng(1)
    poses = np.tile([0.0, 0.0, 0.03, 1.0, 0.0, 0.0, 0.0], (count, 1))
    poses[:, :3] += rng.normal(scale=0.003, size=(count, 3))
    flex = np.where(np.arange(count) % 5, rng.random(count), np.nan)
    mug.trials.add(
        poses,
        ["success" if i % 3 else "slipped" for i in range(count)],
        gripper="mine",
        source="robot",
        protocol="lift",
        proposal_density=np.where(np.arange(count) % 2, 40.0, np.nan),
        qualities={"flex": flex, "rank": np.arange(count)},
        width_m=0.04,
        pose_covariance=np.eye(6) * 1e-6,
        metadata=[{"i": i} if i % 7 == 0 else None for i in range(count)],
        achieved_poses=[poses[0] if i in (4, 7) else None for i in range(count)],
        licence="CC-BY-NC-4.0",
        citation="Doe 2020",
        origin={"file": "mug.h5", "format": "acronym", "sha256": "ab" * 32},
    )
    db.grippers.update("mine", **{**MINE, "force_n": 20.0})
    mug.trials.add(poses + np.eye(7)[0] * 0.001, True, gripper="mine", quality=0.5, metadata={"run": 2})
    mug.trials.add(poses[:3], False)
    # One with an achieved pose and metadata of its own.
    mug.trials.withdraw(8, reason="seen on the video")
    mug.trials.withdraw(2 * count + 3)
    db.kernels.fit("mug", gripper="mine", protocol="lift")
    db.objects.create("plain", name="without a mesh", friction=0.4)


def _trials(db: Client, id: str) -> list[dict[str, Any]]:
    return [trial.model_dump(include=OWN) for trial in db.objects.get(id).trials]


def test_another_database_takes_it_in_whole(here: Client, there: Client, tmp_path: Path) -> None:
    _fill(here)
    path = tmp_path / "mug.zip"
    told: list[tuple[int, int]] = []
    saved = saving.save(here, ["mug", "plain"], path, lambda done, total: told.append((done, total)))
    assert told[-1] == (123, 123)
    assert [(item.id, item.trials, item.withdrawn, item.batches) for item in saved.objects] == [
        ("mug", 123, 2, 3),
        ("plain", 0, 0, 0),
    ]
    assert (sorted(saved.grippers), saved.kernels) == (["mine@1", "mine@2"], 1)
    assert saved.licences == ["CC-BY-NC-4.0"]
    with zipfile.ZipFile(path) as file:
        assert all(info.compress_size < info.file_size for info in file.infolist() if info.file_size)
    made = loading.load(there, path, renamed={"plain": "bare"})
    assert made.objects == {"mug": "mug", "plain": "bare"}
    assert made.grippers == {"mine@1": "mine@1", "mine@2": "mine@2"}
    assert (made.trials, made.batches) == (123, 3)

    assert _trials(there, "mug") == _trials(here, "mug")
    (withdrawn, _) = there.objects.get("mug").trials.list(withdrawn=True)
    assert withdrawn.achieved_pose is not None
    assert (withdrawn.withdrawn, withdrawn.metadata) == (True, {"i": 7})
    before, after = here.objects.get("mug").info, there.objects.get("mug").info
    kept = {
        "name",
        "frames",
        "mass_kg",
        "density_kg_m3",
        "friction",
        "metadata",
        "mesh",
        "convex_parts",
        "outcomes",
    }
    assert after.model_dump(include=kept) == before.model_dump(include=kept)
    assert there.objects.get("mug").download_mesh() == here.objects.get("mug").download_mesh()
    assert there.objects.get("bare").info.friction == 0.4
    own = {"metadata", "licence", "citation", "origin", "qualities", "outcomes", "withdrawn", "inserted"}
    batches = [[b.model_dump(include=own) for b in db.objects.get("mug").batches] for db in (here, there)]
    assert batches[0] == batches[1]
    for version in ("mine@1", "mine@2"):
        assert there.grippers.get(version).profile == here.grippers.get(version).profile
    (old,), (new,) = here.kernels, there.kernels
    assert (new.kind, new.alignment, new.gripper) == (old.kind, old.alignment, old.gripper)
    for one, other in zip(old.components, new.components, strict=True):
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9)
    chosen = {"gripper": "mine", "protocol": "lift"}
    first, second = (db.objects.get("mug").best_grasp(**chosen) for db in (here, there))
    np.testing.assert_allclose(first.matrix, second.matrix, atol=1e-6)
    # What was taken in is saved as it was.
    again = saving.save(there, ["mug"], tmp_path / "again.zip")
    member = archive.member_of(0, "trials")
    assert again.members[member].sha256 == saved.members[member].sha256


def test_twice_is_refused_and_a_new_id_takes_it(here: Client, tmp_path: Path) -> None:
    _fill(here)
    path = tmp_path / "mug.zip"
    saving.save(here, ["mug"], path)
    with pytest.raises(BundleProblem, match=r"object 'mug' already.*--as"):
        loading.load(here, path)
    made = loading.load(here, path, renamed={"mug": "cup"})
    assert made.grippers == {"mine@1": "mine@1", "mine@2": "mine@2"}, "the same profiles are there"
    assert _trials(here, "cup") == _trials(here, "mug")
    with pytest.raises(ValueError, match="no object 'mag'"):
        loading.load(here, path, renamed={"mag": "x"})


def test_another_profile_is_not_overwritten(here: Client, there: Client, tmp_path: Path) -> None:
    _fill(here)
    path = tmp_path / "mug.zip"
    saving.save(here, ["mug"], path)
    there.grippers.create("mine", **{**MINE, "max_opening_m": 0.07})
    with pytest.raises(BundleProblem, match=r"differs from the bundle's in max_opening_m.*--new-gripper"):
        loading.load(there, path)
    assert list(there.objects) == []
    made = loading.load(there, path, new_gripper_versions=True)
    assert made.grippers == {"mine@1": "mine@2", "mine@2": "mine@3"}
    assert there.grippers.get("mine@1").profile.max_opening_m == 0.07
    assert {trial.gripper_version for trial in there.objects.get("mug").trials} == {2, 3, None}


def test_what_can_not_be_taken_in_leaves_nothing(here: Client, there: Client, tmp_path: Path) -> None:
    """A service that refuses half-way: what was made before goes again."""
    _fill(here)
    path = tmp_path / "mug.zip"
    saving.save(here, ["plain", "mug"], path)

    def break_it(members: dict[str, bytes]) -> None:
        rows = members["objects/1/trials"].splitlines(keepends=True)
        rows[-1] = rows[-1].replace(b"failure", b"wonder!")
        members["objects/1/trials"] = b"".join(rows)

    _rewrite(path, break_it)
    with pytest.raises(GraspDBError, match="not valid"):
        loading.load(there, path)
    assert list(there.objects) == []
    assert [item.id for item in there.grippers if not item.builtin] == []
    assert list(there.kernels) == []


def _rewrite(path: Path, change: Callable[[dict[str, bytes]], None], *, honest: bool = True) -> None:
    """Change members, and, for an ``honest`` forgery, the manifest with them."""
    with zipfile.ZipFile(path) as file:
        members = {name: file.read(name) for name in file.namelist()}
    change(members)
    if honest:
        manifest = json.loads(members["manifest.json"])
        for name, told in manifest["members"].items():
            content = members[name]
            told |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        members["manifest.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)


def _told(change: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, bytes]], None]:
    """A change of the manifest."""

    def rewrite(members: dict[str, bytes]) -> None:
        manifest = json.loads(members["manifest.json"])
        change(manifest)
        members["manifest.json"] = json.dumps(manifest).encode()

    return rewrite


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory, serve_module: Any, empty_module_url: str) -> Path:
    path = tmp_path_factory.mktemp("bundle") / "mug.zip"
    with Client(serve_module(empty_module_url), retries=0) as db:
        _fill(db)
        saving.save(db, ["mug"], path)
    return path


@pytest.fixture(scope="module")
def empty_module_url(tmp_path_factory: pytest.TempPathFactory) -> str:
    return f"sqlite:///{tmp_path_factory.mktemp('data')}/graspdb.sqlite"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda m: m.pop("manifest.json"), "manifest"),
        (lambda m: m.pop("objects/0/mesh"), "disagree"),
        (lambda m: m.update({"objects/7/mesh": b"x"}), "disagree"),
        (lambda m: m.update({"../../etc/passwd": b"x"}), "no bundle does"),
        (lambda m: m.update({"/etc/passwd": b"x"}), "no bundle does"),
        (lambda m: m.update({"objects/0/mesh": m["objects/0/mesh"][:-1] + b"x"}), "SHA-256"),
        (lambda m: m.update({"objects/0/mesh": b"x"}), "not as large"),
        (lambda m: m.update({"manifest.json": b"[]"}), "does not say"),
        (lambda m: m.update({"manifest.json": b"{"}), "no JSON"),
        (lambda m: m.update({"manifest.json": b"[" * 100_000}), "no JSON"),
        (_told(lambda m: m.update(version=2)), "version 2.*reads version 1"),
        (_told(lambda m: m.update(format="other")), "does not say"),
        (_told(lambda m: m["objects"][0].update(trials=5)), "number of trials"),
        (_told(lambda m: m.update(kernels=2)), "number of kernels"),
        (_told(lambda m: m["objects"][0]["properties"].update(id="../x")), "does not say"),
        (_told(lambda m: m["members"]["objects/0/trials"].update(lines=5)), "lines"),
        (lambda m: m.update({"objects/0/trials": b"0" * 300_000_000}), "as large as it is"),
    ],
)
def test_a_forged_bundle_is_refused(
    here: Client, bundle: Path, tmp_path: Path, change: Any, told: str
) -> None:
    path = tmp_path / "forged.zip"
    path.write_bytes(bundle.read_bytes())
    _rewrite(path, change, honest=False)
    with pytest.raises(BundleProblem, match=told):
        loading.load(here, path)
    assert list(here.objects) == []


@pytest.mark.parametrize(
    "row", [b"[]", b"{}", b'{"batch": 9}', b'{"batch": "0"}', b"{", b"[" * 10_000, b"{" + b" " * 2**24 + b"}"]
)
def test_a_forged_line_is_refused(here: Client, bundle: Path, tmp_path: Path, row: bytes) -> None:
    path = tmp_path / "forged.zip"
    path.write_bytes(bundle.read_bytes())

    def change(members: dict[str, bytes]) -> None:
        rows = members["objects/0/trials"].splitlines(keepends=True)
        members["objects/0/trials"] = b"".join([*rows[:-1], row, b"\n"])

    _rewrite(path, change)
    with pytest.raises(BundleProblem):
        loading.load(here, path)
    assert list(here.objects) == []
    assert [item.id for item in here.grippers if not item.builtin] == []


def test_a_damaged_or_cut_file_is_refused(here: Client, bundle: Path, tmp_path: Path) -> None:
    content = bundle.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [content[: len(content) // 2], content[:-5], b"", b"PK\x05\x06" + b"\0" * 18, b"hello"]
    for at in rng.integers(0, len(content), 20).tolist():
        damaged.append(content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :])
    path = tmp_path / "damaged.zip"
    for number, wrong in enumerate(damaged):
        path.write_bytes(wrong)
        try:
            loading.load(here, path)
        except BundleProblem:
            assert list(here.objects) == [], number
        else:
            # A byte that says nothing, such as a member's time.
            here.kernels.delete(next(iter(here.kernels)).id)
            here.objects.get("mug").delete()
            here.grippers.delete("mine")


def test_an_object_that_changes_meanwhile_is_not_saved(here: Client, tmp_path: Path) -> None:
    _fill(here)
    path = tmp_path / "mug.zip"

    def meanwhile(done: int, total: int) -> None:
        here.objects.get("mug").trials.add(np.eye(4), True)

    with pytest.raises(BundleProblem, match="changed"):
        saving.save(here, ["mug"], path, meanwhile)
    assert list(tmp_path.glob("*mug.zip*")) == []


def test_the_command_saves_and_takes_in(
    run: Callable[..., Any], db: Client, fresh_id: str, tmp_path: Path
) -> None:
    item = db.objects.create(fresh_id, mesh=_box(0.04, 0.06, 0.1))
    item.trials.add(np.eye(4), True, gripper="panda", licence="MIT")
    path = str(tmp_path / "o.zip")
    code, out, err = run("bundle", fresh_id, "-o", path)
    assert code == 0, err
    assert "1 trials" in out
    assert "MIT" in out
    code, _, err = run("bundle", "--load", path)
    assert code == 1
    assert "--as OLD=NEW" in err
    code, out, err = run("--json", "bundle", "--load", path, "--as", f"{fresh_id}={fresh_id}-2")
    assert code == 0, err
    assert json.loads(out)["objects"] == {fresh_id: f"{fresh_id}-2"}
    assert db.objects.get(f"{fresh_id}-2").info.trials == 1
    for wrong in ([], [fresh_id], ["-o", path], ["--load", path, fresh_id], ["--load", path, "--as", "x"]):
        assert run("bundle", *wrong)[0] == 2, wrong
