"""Verifying labels and drawing grasps."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspdb.examples import example
from graspdb.wire import SimulatePayload
from graspdb_service.usecases.grippers import BUILTIN
from graspdb_simworker import png, sources, verification
from graspdb_simworker.labels import Outcome


def test_labels_hold_at_a_finer_step(payload_of: Callable[..., SimulatePayload]) -> None:
    seen: list[tuple[int, int]] = []
    found = verification.verify(
        payload_of("mug", stop=3_000),
        example("mug").parts,
        count=60,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1] == (seen[-1][1], seen[-1][1])
    assert {s.outcome for s in found.strata} >= {Outcome.SUCCESS, Outcome.SLIPPED}
    assert 50 <= found.checked <= 66
    for stratum in found.strata:
        assert 0 < stratum.checked <= stratum.available
        assert stratum.same <= stratum.agree <= stratum.checked
    assert found.agreement >= 0.93
    assert 0.85 < found.lower < found.agreement
    assert found.same <= found.agreement


def test_disagreement_counts_by_the_share_of_its_outcome() -> None:
    before = np.array([1] * 40 + [4] * 10, dtype=np.uint8)
    after = before.copy()
    after[40:45] = Outcome.SUCCESS  # half the slipped ones are successes after all
    after[45:48] = Outcome.MISSED  # and some fail otherwise
    found = verification._agreement({1: 900.0, 4: 100.0}, before, after, np.random.default_rng(0))
    assert found.agreement == pytest.approx(0.9 + 0.1 * 0.5)
    assert found.same == pytest.approx(0.9 + 0.1 * 0.2)
    # Forty of forty and five of ten, weighed: some percent lower at 95 %.
    assert 0.88 < found.lower < 0.94


def pixels(data: bytes) -> np.ndarray:
    """Decode a PNG of this package's kind, checking every block."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, blocks = 8, {}
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        assert struct.unpack_from(">I", data, at + 8 + length)[0] == zlib.crc32(kind + body)
        blocks[kind] = body
        at += 12 + length
    width, height, depth, colour = struct.unpack_from(">IIBB", blocks[b"IHDR"])
    assert (depth, colour) == (8, 2)
    rows = np.frombuffer(zlib.decompress(blocks[b"IDAT"]), np.uint8).reshape(height, 1 + 3 * width)
    assert not rows[:, 0].any()
    return rows[:, 1:].reshape(height, width, 3)


def test_a_png_holds_its_image() -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    np.testing.assert_array_equal(pixels(png.encode(image)), image)
    with pytest.raises(ValueError, match="uint8"):
        png.encode(image.astype(np.float64))  # type: ignore[arg-type]


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "graspdb_simworker.cli", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_show_draws_the_grasp_it_simulates(tmp_path: Path) -> None:
    done = run("show", "mug", "--position", "0,0.028,0.035", "--quaternion", "1,0,0,0", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith("success: fingers 0.005")
    image = pixels((tmp_path / "grasp.png").read_bytes())
    assert image.shape == (480, 1280, 3)
    # Both views show the orange mug, the dark fingers and the grey palm, before white.
    red, green, blue = (image[..., k].astype(int) for k in range(3))
    orange, dark = (red > green + 40) & (green > blue + 20), (red < 70) & (blue < 100)
    for half in (slice(0, 640), slice(640, 1280)):
        assert orange[:, half].mean() > 0.02
        assert dark[:, half].mean() > 0.005

    collision = run("show", "mug", "--position", "0,0,0.02", folder=tmp_path)
    assert collision.returncode == 0
    assert collision.stdout.splitlines()[-1].startswith("collision")


@pytest.mark.parametrize("gripper", ["pg70", "panda"])
def test_a_gripper_without_a_service_is_the_one_that_services_have(gripper: str) -> None:
    payload, _ = sources.load("cone", gripper)
    _, profile = BUILTIN[gripper]
    not_simulated = {"base_to_tool", "max_acceleration_m_s2"}
    assert payload.gripper.model_dump(exclude=not_simulated) == profile.model_dump(exclude=not_simulated)


def test_show_names_what_is_wrong(tmp_path: Path) -> None:
    for arguments, word in (
        (("show", "teapot"), "teapot"),
        (("show", "mug", "--quaternion", "1,0,0,1"), "norm"),
        (("verify", "mug", "--gripper", "claw"), "claw"),
        (("verify", "mug", "--protocol", "shake"), "shake"),
        (("verify", "--sweep", "abc"), "--url"),
        (("verify",), "name an object"),
    ):
        done = run(*arguments, folder=tmp_path)
        assert done.returncode == 1
        assert word in done.stderr
        assert "Traceback" not in done.stderr
