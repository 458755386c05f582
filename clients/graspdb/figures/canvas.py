"""What figures are drawn on: matplotlib's figures and axes, made, placed and ruled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:  # what draws imports matplotlib, an extra; annotations do not need it
    Axes = Figure = Any


def new_figure(width: float | None = None, height: float | None = None) -> Figure:
    """A figure of this size in inches, laid out by itself; without a size, whoever draws places its axes.

    Made without pyplot, so that a server may draw from its threads.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("figures need matplotlib: pip install 'graspdb[plot]'") from error
    if width is None or height is None:
        return Figure()
    return Figure(figsize=(width, height), layout="constrained")


def place(figure: Figure, left: float, bottom: float, width: float, height: float, **shared: Any) -> Axes:
    """Axes at a place on the figure, in inches: a layout that measures every label takes seconds for many."""
    size = np.tile(figure.get_size_inches(), 2)
    return figure.add_axes(tuple(np.array([left, bottom, width, height]) / size), **shared)


def show_grid(axes: Axes) -> None:
    """A grid behind, ticks that can be read, and no frame above and to the right."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.9", linewidth=0.6)
    axes.tick_params(labelsize=8)
    axes.set_axisbelow(True)


def show_ticks(axes: Axes, values: list[float]) -> None:
    """Ticks at these values only."""
    axes.set_xticks(values, [f"{value:,.0f}" if value >= 10 else f"{value:.3g}" for value in values])
    axes.minorticks_off()
