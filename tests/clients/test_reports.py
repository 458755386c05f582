"""Reports and kernels through the SDK and the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from graspdb import Client, figures
from graspdb.asynchronous import AsyncReports
from graspdb.errors import ChecksNeeded, Conflict, NotFound
from graspdb.reports import Report, Reports, Waiting
from graspdb.resources.objects import GraspObject
from graspdb.wire.reports import REPORT_NAMES, REPORTS

Run = Callable[..., tuple[int, str, str]]


def field(count: int = 2_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 7) about one grasp and whether they hold: wide along x, narrow along y."""
    rng = np.random.default_rng(seed)
    widths = np.array([0.03, 0.006, 0.012, 0.2, 0.8, 0.2])
    xi = rng.uniform(-2.0, 2.0, (count, 6)) * widths
    angle = np.linalg.norm(xi[:, 3:], axis=1, keepdims=True)
    q = np.concatenate([xi[:, 3:] / angle * np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    return np.concatenate([xi[:, :3], q], axis=1), np.sum((xi / widths) ** 2, axis=1) < 5.0


@pytest.fixture
def thing(db: Client, fresh_id: str) -> GraspObject:
    item = db.objects.create(fresh_id)
    item.trials.add(*field())
    return item


def test_a_report_is_declared_once() -> None:
    """The SDK takes the options of the wire, and waits; every answer is named and drawn."""
    assert set(REPORTS) == set(REPORT_NAMES)
    for name, declared in REPORTS.items():
        method = getattr(Reports, name.replace("-", "_"))
        (keywords,) = get_args(get_type_hints(method)["options"])
        assert set(keywords.__optional_keys__ - Waiting.__optional_keys__) == set(
            declared.options.model_fields
        )
        assert declared in figures._DRAW
        assert hasattr(AsyncReports, name.replace("-", "_"))


def test_reports_have_words_arrays_and_figures(thing: GraspObject, tmp_path: Path) -> None:
    convergence = thing.reports.convergence()
    assert convergence.enough == (convergence.verdict.state == "enough")
    assert len(convergence.grasps) == len(convergence.similarity) == len(convergence.log_likelihood) >= 4
    assert (np.diff(convergence.grasps) > 0).all()
    assert convergence.text in repr(convergence)
    assert "Convergence of" in convergence._repr_html_()

    anisotropy = thing.reports.anisotropy()
    assert set(anisotropy.tolerances) == {"x", "y", "z", "rx", "ry", "rz"}
    x, y = anisotropy.forgives["x"], anisotropy.forgives["y"]
    assert x is not None
    assert y is not None
    assert x > 1.5 * y
    assert "forgives" in repr(anisotropy)
    for axis, (low, high) in anisotropy.tried.items():
        assert low < 0 < high
        assert (anisotropy.forgives[axis] or 0.0) <= max(-low, high)

    calibration = thing.reports.calibration()
    assert calibration.skill is not None
    assert calibration.skill > 0
    assert len(calibration.predicted) == len(calibration.observed) == 10
    assert calibration.warnings
    assert "mind:" in repr(calibration)

    for report in (convergence, anisotropy, calibration):
        figure = report.plot()
        texts = " ".join(text.get_text() for text in figure.findobj(lambda a: hasattr(a, "get_text")))
        assert thing.id in texts
        # Everything drawn lies on the page.
        box = figure.get_tightbbox()
        assert box.width <= figure.get_figwidth() + 0.01
        assert box.height <= figure.get_figheight() + 0.01
    png, svg = tmp_path / "a.png", tmp_path / "a.svg"
    convergence.save(png)
    convergence.save(svg)
    assert png.read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in svg.read_bytes()
    with pytest.raises(ValueError, match=r"\.pdf"):
        convergence.save(tmp_path / "a.pdf")


def drawn_on_the_page(report: Report[Any], words: str) -> None:
    """The figure says what it is of, and everything drawn lies on the page."""
    figure = report.plot()
    figure.draw_without_rendering()
    texts = " ".join(text.get_text() for text in figure.findobj(lambda a: hasattr(a, "get_text")))
    assert words in texts
    box = figure.get_tightbbox()
    assert box.x0 >= -0.01
    assert box.y0 >= -0.01
    assert box.x1 <= figure.get_figwidth() + 0.01
    assert box.y1 <= figure.get_figheight() + 0.01


def test_projections(thing: GraspObject, run: Run) -> None:
    found = thing.reports.projection(plane=(0, -1, 0), approach="z", approach_cone_deg=20)
    assert found.values.shape == (len(found.across_m) - 1, len(found.upward_m) - 1)
    assert found.values.max() == 1
    assert found.share is not None
    assert 0.2 < found.share < 1
    drawn_on_the_page(found, thing.id)
    drawn_on_the_page(thing.reports.projection(), "all grasps")
    with pytest.raises(ValueError, match="approach has shape"):
        thing.reports.projection(approach=[1, 2])
    code, out, err = run("report", thing.id, "projection", "--plane", "xz", "--approach", "z")
    assert (code, "of the density approaches within 30 deg of z" in out) == (0, True), err
    code, _, err = run("report", thing.id, "calibration", "--plane", "xz")
    assert (code, "no such option" in err) == (2, True)
    assert run("report", thing.id)[0] == 2
    code, out, err = run("report", thing.id, "anisotropy")
    assert (code, "along x" in out, "about z" in out, "tried" in out) == (0, True, True, True), err


def test_widths_and_the_summary_of_all_objects(
    thing: GraspObject, db: Client, run: Run, tmp_path: Path
) -> None:
    found = thing.reports.bandwidth()
    assert found.recommended[0] in {point.sigma_position_m for point in found.raw.grid}
    assert {call.path for call in found.calls} == {f"/objects/{thing.id}/sweeps"}
    drawn_on_the_page(found, "No draws were simulated yet")
    with pytest.raises(Conflict, match="has no mesh"):
        thing.reports.simulate(found.calls)
    with pytest.raises(ValueError, match="makes no sweep of this object"):
        thing.reports.simulate([{"method": "DELETE", "path": f"/objects/{thing.id}", "body": {}}])
    code, out, err = run("report", thing.id, "bandwidth")
    assert (code, "Recommended" in out, "bandwidth --simulate` makes" in err) == (0, True, True)

    every = db.reports.summary()
    (row,) = (row for row in every.raw.rows if row.object == thing.id)
    won = int(field()[1].sum())
    assert row.outcomes == {"failure": 2_000 - won, "success": won}
    assert every.rates("attempts")[thing.id] == won / 2_000
    assert "Summary of all objects" in repr(every)
    drawn_on_the_page(every, "what was tried")
    code, out, _ = run("report", "summary", "--figure", str(tmp_path / "all.svg"))
    assert (code, thing.id[:12] in out) == (0, True)
    assert b"<svg" in (tmp_path / "all.svg").read_bytes()
    code, out, _ = run("--json", "report", "summary")
    assert json.loads(out)["report"] == "summary"


def test_similarity_of_kernels_and_sources(thing: GraspObject, run: Run) -> None:
    asked = {"window_position_m": 0.03, "window_rotation_deg": 60}
    found = thing.reports.kernel_similarity(**asked, timeout_s=240)
    counts, similarity = found.samples
    assert counts[0] == 50
    assert similarity[-1] > similarity[0]
    assert found.mixtures[0].tolist() == list(range(1, 17))
    drawn_on_the_page(found, "900: the paper")
    code, out, _ = run(
        "report", thing.id, "kernel-similarity", "--window-position-m", "0.03", "--window-rotation-deg", "60"
    )
    assert (code, "Gaussians" in out) == (0, True)
    poses, won = field(seed=1)
    thing.trials.add(poses, won, source="simulation")
    thing.trials.add(poses[:200], won[:200], source="robot")
    compared = thing.reports.sources()
    assert set(compared.by_source) == {"robot"}
    drawn_on_the_page(compared, "agreement with")
    code, out, _ = run("report", thing.id, "sources")
    assert (code, "agreement" in out) == (0, True)


def test_too_few_trials_raise_what_is_needed(db: Client, fresh_id: str) -> None:
    item = db.objects.create(fresh_id)
    with pytest.raises(Conflict, match="at least 200 successful grasps"):
        item.reports.convergence()
    with pytest.raises(Conflict, match="at least 20 successes"):
        item.reports.anisotropy()
    with pytest.raises(Conflict, match="POST /kernels"):
        item.reports.convergence(kernel="anisotropic")


def test_kernels_are_fitted_and_used(db: Client, thing: GraspObject) -> None:
    made = db.kernels.fit(thing.id)
    assert made.id in [kernel.id for kernel in db.kernels]
    assert made.widths_m[0] > made.widths_m[1]
    assert made.id in repr(made)
    assert "covariance" not in repr(made)
    used = thing.density(kernel="anisotropic").kernel
    assert (used.id, used.alignment) == (made.id, "gripper")
    assert thing.best_grasp(kernel=made.id).relative == pytest.approx(1, abs=0.02)
    with pytest.raises(ChecksNeeded) as refused:
        thing.reports.convergence(kernel=made.id, matching="success")
    calls = refused.value.calls
    assert made.id in [call.body["sample"]["kernel"] for call in calls]
    assert {call.body["purpose"] for call in calls} == {"check"}
    with pytest.raises(Conflict, match="has no mesh"):
        thing.reports.simulate(calls)
    given = db.kernels.create([{"covariance": made.components[0].covariance}])
    assert given.provenance.origin == "given"
    for kernel in (made, given):
        db.kernels.delete(kernel.id)
    with pytest.raises(NotFound):
        db.kernels.get(made.id)


def test_on_the_command_line(run: Run, thing: GraspObject, tmp_path: Path) -> None:
    png = tmp_path / "out.png"
    code, out, err = run("report", thing.id, "convergence", "--figure", str(png))
    assert code == 0, err
    assert "similarity" in out
    assert png.read_bytes().startswith(b"\x89PNG")
    code, out, _ = run("report", thing.id, "anisotropy", "--method", "empirical")
    assert (code, "forgives" in out) == (0, True)
    code, out, err = run("report", thing.id, "calibration")
    assert (code, "Brier skill" in out, "Mind:" in err) == (0, True, True)
    code, out, _ = run("--json", "report", thing.id, "calibration")
    assert json.loads(out)["report"] == "calibration"
    code, _, err = run("report", thing.id, "anisotropy", "--matching", "likelihood")
    assert (code, "no such option" in err) == (2, True)
    assert run("report", thing.id, "guesses")[0] == 2
    assert run("report", thing.id, "convergence", "--figure", "x.pdf")[0] == 2
    code, _, err = run("report", thing.id, "anisotropy", "--alignment", "object")
    assert (code, "has no mesh" in err) == (1, True)

    code, out, _ = run("--json", "kernels", "fit", thing.id)
    kernel = json.loads(out)["id"]
    assert kernel in run("kernels", "list")[1]
    code, out, _ = run("density", thing.id, "--kernel", "anisotropic")
    assert (code, "anisotropic" in out) == (0, True)
    assert run("best-grasp", thing.id, "--kernel", kernel)[0] == 0
    assert run("samples", thing.id, "--kernel", kernel)[0] == 0
    assert run("likelihood", thing.id, "--pose=0,0,0,0,0,0,1", "--kernel", kernel)[0] == 0
    code, out, _ = run("report", thing.id, "convergence", "--kernel", kernel)
    assert (code, "times the grasps of the matched isotropic kernel" in out) == (0, True)
    by_success = ("report", thing.id, "convergence", "--kernel", kernel, "--matching", "success")
    code, _, err = run(*by_success)
    assert (code, "have not all been simulated" in err) == (1, True)
    # It makes the sweeps, which this object without a mesh refuses.
    code, _, err = run(*by_success, "--simulate")
    assert (code, "has no mesh" in err) == (1, True)
    assert run("kernels", "delete", kernel)[0] == 0
    assert kernel not in run("kernels", "list")[1]
