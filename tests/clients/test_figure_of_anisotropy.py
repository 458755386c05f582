"""The figure of the anisotropy report: expectations and relations in words, counts, nothing over another."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from graspdb.figures import draw, render
from graspdb.wire.reports import AnisotropyReport, AnisotropyTolerance


def histogram(axes: tuple[str, str], edges: np.ndarray, slice_m: list[float] | None) -> dict[str, Any]:
    n = len(edges) - 1
    share = np.linspace(0.0, 1.0, n * n).reshape(n, n).tolist()
    share[0][0] = None
    return {
        "axes": axes, "edges": [edges.tolist()] * 2, "slice_m": slice_m, "probability": share, "low": share,
        "high": share, "count": np.full((n, n), 12_345).tolist(),
    }  # fmt: skip


def tolerance(axis: str, **changed: Any) -> dict[str, Any]:
    turn = axis.startswith("r")
    at = np.linspace(-1.5, 1.5, 16) if turn else np.linspace(-0.075, 0.075, 16)
    share = np.exp(-np.abs(at) / at.max())
    return {
        "axis": axis, "unit": "rad" if turn else "m", "half_width": 0.5 * at.max(), "low": 0.4 * at.max(),
        "high": 0.6 * at.max(), "minus": 0.5 * at.max(), "plus": 0.5 * at.max(), "beyond": False,
        "displacement": at.tolist(), "probability": share.tolist(), "profile_low": (0.9 * share).tolist(),
        "profile_high": np.minimum(1.0, 1.1 * share).tolist(), "count": [1_234] * len(at), **changed,
    }  # fmt: skip


def relation(kind: str, angle: tuple[float, float] | None, share: float | None) -> dict[str, Any]:
    low, high = (None, None) if share is None else (0.9 * share, min(1.0, 1.1 * share))
    return {
        "relation": kind, "angle_deg": angle, "attempts": 262_345, "collisions": 200_000, "successes": 9_876,
        "probability": share, "low": low, "high": high, "free_probability": share, "free_low": low,
        "free_high": high,
    }  # fmt: skip


HYPOTHESES = [
    {"name": "x-wide", "ratio": 1.84, "low": 1.79, "high": 1.89, "verdict": "confirmed"},
    {"name": "z-wide", "ratio": 1.02, "low": 0.9, "high": 1.1, "verdict": "undecided"},
    {"name": "ry-wide", "ratio": 0.41, "low": 0.39, "high": 0.42, "verdict": "denied", "bound": "upper"},
    {
        "name": "alignment-sharpens", "ratio": 2.87, "low": 2.79, "high": 2.99, "verdict": "confirmed",
        "bound": "lower",
    },
]  # fmt: skip
ANGLES = ((0, 10), (10, 20), (20, 30), (30, 45), (45, 90))
RELATIONS = [
    relation(kind, angle, 0.1 + 0.005 * angle[1])
    for kind in ("surfaces", "coplanar-edges", "parallel-edges")
    for angle in ANGLES
] + [relation("none", None, 0.003)]


def report(**changed: Any) -> AnisotropyReport:
    side, circle = np.linspace(-0.04, 0.04, 10), np.linspace(-math.pi, math.pi, 25)
    return AnisotropyReport.model_validate(
        {
            "object": "elongated-d", "revision": 7, "gripper": "pg70", "protocol": "wrench",
            "text": "A good grasp forgives 24 mm (23 to 25) along x, and this sentence goes on. " * 9,
            "method": "empirical", "alignment": "surface-pair", "level": 0.9, "grasps": 2_000,
            "attempts": 32_000_000, "translation_pairs": 1, "rotation_pairs": 1, "aligned": 1_999,
            "tolerances": [tolerance(axis) for axis in ("x", "y", "z", "rx", "ry", "rz")],
            "translations": [
                histogram(("x", "y"), side, [z, z + 0.016]) for z in (-0.04, -0.024, -0.008, 0.008, 0.024)
            ],
            "rotations": [
                histogram(axes, circle, None) for axes in (("rx", "ry"), ("rx", "rz"), ("ry", "rz"))
            ],
            "hypotheses": HYPOTHESES, "relations": RELATIONS, **changed,
        }
    )  # fmt: skip


def words(figure: Any) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(lambda a: hasattr(a, "get_text")))


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"hypotheses": []},
        {"relations": []},
        {"hypotheses": HYPOTHESES[:1], "relations": RELATIONS[-1:], "text": "Short."},
    ],
)
def test_nothing_lies_over_another(changed: dict[str, Any]) -> None:
    figure = draw(report(**changed))
    figure.draw_without_rendering()
    renderer = figure._get_renderer()
    boxes = [axes.get_tightbbox(renderer) for axes in figure.axes]
    boxes.append(figure._suptitle.get_window_extent(renderer))
    for one, other in itertools.combinations(boxes, 2):
        common = type(one).intersection(one, other)
        assert common is None or min(common.width, common.height) < 1.0
    page = figure.get_tightbbox()
    assert min(page.x0, page.y0) >= 0.0
    assert page.x1 <= figure.get_figwidth()
    assert page.y1 <= figure.get_figheight()


def test_verdicts_are_told_in_words_with_their_numbers() -> None:
    figure = draw(report())
    told = words(figure)
    assert "1.84 (1.79 to 1.89):\nconfirmed" in told
    assert "1.02 (0.90 to 1.10):\nundecided" in told
    assert "at most 0.41 (0.39 to 0.42):\ndenied" in told
    assert "at least 2.87 (2.79 to 2.99):\nconfirmed" in told
    (forest,) = (axes for axes in figure.axes if "half widths" in axes.get_xlabel())
    assert forest.get_xscale() == "log"
    assert forest.get_xlim()[0] < 0.39
    assert forest.get_xlim()[1] > 2.99
    # Told apart without colour: another marker for every verdict.
    markers = {line.get_marker() for line in forest.lines} - {"None", None, ""}
    assert len(markers) == 3


def test_relations_have_counts_units_and_intervals() -> None:
    figure = draw(report())
    told = words(figure)
    assert "opposite surfaces, the closing axis off theirs by" in told
    assert "30 to 45\u00b0" in told
    assert told.count("n = 262,345; 62,345 do not collide") == len(RELATIONS)
    (shares,) = (axes for axes in figure.axes if "share that succeeded, 90% intervals" in axes.get_xlabel())
    assert len(shares.containers) == 2
    assert all(container.has_xerr for container in shares.containers)


def test_what_can_not_be_told_is_left_out() -> None:
    unknown = {"name": "ry-wide", "ratio": None, "low": None, "high": None, "verdict": "undecided"}
    full = draw(report())
    less = draw(report(hypotheses=[unknown], relations=[relation("none", None, None)]))
    assert less.get_figheight() < full.get_figheight() - 3.0
    assert "expects" not in words(less)
    nothing = tolerance("x", half_width=None, displacement=[], probability=[], profile_low=[],
                        profile_high=[], count=[], low=None, high=None, minus=None, plus=None)  # fmt: skip
    assert "nothing tried" in words(draw(report(tolerances=[nothing])))


def test_bounds_are_told_and_what_was_not_tried_is_hatched() -> None:
    told: dict[str, dict[str, Any]] = {
        "x": {"beyond": True, "half_width": 0.03, "low": 0.012, "high": 0.03, "tried": [-0.03, 0.03]},
        "y": {"within": True, "half_width": 0.01, "low": None, "high": None, "tried": [-0.06, 0.06]},
        "z": {"beyond": True, "half_width": 0.024, "low": 0.02, "high": 0.03, "tried": [-0.026, 0.044]},
        "rz": {"beyond": True, "half_width": 0.5, "low": 0.5, "high": 0.5, "tried": [-0.5, 0.5]},
    }
    items = [AnisotropyTolerance.model_validate(tolerance(axis, **more)) for axis, more in told.items()]
    assert [item.in_words() for item in items] == [
        "at least 12 mm (tried to 30)",
        "less than 10 mm",
        "at least 20 mm (tried -26 to 44)",
        "at least 29 deg",
    ]
    figure = draw(report(tolerances=[tolerance(axis, **more) for axis, more in told.items()]))
    profiles = {axes.get_xlabel(): axes for axes in figure.axes if axes.get_title().startswith("forgives")}
    for label, ends in (("along x [mm]", (-30.0, 30.0)), ("along y [mm]", (-60.0, 60.0))):
        hatched = [fill for fill in profiles[label].collections if fill.get_hatch()]
        corners = [fill.get_paths()[0].vertices[:, 0] for fill in hatched]
        assert max(corners[0]) == pytest.approx(ends[0])
        assert min(corners[1]) == pytest.approx(ends[1])
    assert profiles["along x [mm]"].get_xlim() == profiles["along y [mm]"].get_xlim()


def test_an_expectation_without_data_is_undecided() -> None:
    unknown = {"name": "ry-wide", "ratio": None, "low": None, "high": None, "verdict": "undecided"}
    told = words(draw(report(hypotheses=[HYPOTHESES[0], unknown])))
    assert "these trials do not tell:\nundecided" in told
    assert "turns about y forgive more" in told


def test_the_files_are_what_they_are_called_and_alike_every_time() -> None:
    assert render(report(), "png").startswith(b"\x89PNG")
    assert b"<svg" in render(report(), "svg")[:500]
    assert render(report(), "png") == render(report(), "png")


def test_a_lower_bound_is_drawn_as_one_and_few_pairs_apart() -> None:
    """Where a profile falls by a few pairs beyond what the words tell, no half width is drawn."""
    count = [1_234] * 14 + [3, 2]
    bounded = tolerance("rx", beyond=True, low=0.3, tried=(-1.5, 1.5), count=count)
    told = [bounded if axis == "rx" else tolerance(axis) for axis in ("x", "y", "z", "rx", "ry", "rz")]
    found = report(tolerances=told)
    assert found.tolerances[3].in_words().startswith("at least 17 deg")
    figure = draw(found)
    panels = {axes.get_title().partition(":")[0]: axes for axes in figure.axes}
    ends = {
        name: [
            line.get_xdata()[0] for line in panels[f"forgives {name}"].lines if line.get_linestyle() == ":"
        ]
        for name in ("about x", "about y")
    }
    assert (len(ends["about x"]), len(ends["about y"])) == (0, 2)
    marks = [line for line in panels["forgives about x"].lines if line.get_marker() in "<>"]
    assert sorted(line.get_xdata()[0] for line in marks) == pytest.approx(
        [-math.degrees(0.3), math.degrees(0.3)]
    )
    hollow = [line for line in panels["forgives about x"].lines if line.get_linestyle() == "None"]
    assert any(len(line.get_xdata()) == 2 for line in hollow)
