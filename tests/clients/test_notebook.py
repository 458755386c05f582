"""The notebook runs from its first cell to its last, on a mesh and a file of nobody's here."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebooks" / "own_object.ipynb"


def texts(cell: Any) -> str:
    """What a cell printed or showed as text."""
    return "".join(
        output.get("text", "") or output.get("data", {}).get("text/plain", "") for output in cell.outputs
    )


def test_from_mesh_and_data_to_the_flange(
    service_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRASPDB_URL", service_url)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "outputs are not kept"
    NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()
    cells = {cell.source: texts(cell) for cell in notebook.cells if cell.cell_type == "code"}
    (best,) = (told for source, told in cells.items() if "best_grasp(" in source)
    numbers = re.findall(r"-?\d+\.\d*", best[: best.index("]]")])
    flange = np.array(numbers, dtype=float).reshape(4, 4)
    # The tool points down, 0.1 m and more below the flange, over the bracket half a metre ahead.
    assert flange[:3, 3] == pytest.approx([0.5, 0.0, 0.13], abs=0.06)
    assert flange[2, 2] < -0.7
    (chance,) = (told for source, told in cells.items() if "chance()" in source)
    assert chance.startswith("0.")
    assert any(
        "image/png" in out.get("data", {}) for cell in notebook.cells for out in cell.get("outputs", [])
    )
