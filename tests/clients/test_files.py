"""Trials and poses in files: what is read, and what is said of what cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from graspdb.files.trials import as_stated, read_drawn_poses, read_poses, read_trials

HEADER = "x,y,z,qx,qy,qz,qw"
POSE = {"position": [0.1, 0.2, 0.3], "quaternion_xyzw": [0, 0, 0, 1]}
ROW = [0.1, 0.2, 0.3, 0, 0, 0, 1]


def _file(folder: Path, name: str, content: object) -> str:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    "content",
    [
        {**POSE, "outcome": "success"},
        [{**POSE, "outcome": "success"}],
        {"trials": [{**POSE, "outcome": "success"}]},
        {
            "columns": {
                "position": [ROW[:3]],
                "quaternion_xyzw": [ROW[3:]],
                "outcome": ["success"],
                "quality": [None],
            }
        },
    ],
)
def test_json_in_every_form(tmp_path: Path, content: object) -> None:
    assert read_trials(_file(tmp_path, "t.json", content)) == ([{**POSE, "outcome": "success"}], {})


def test_another_unit_and_order_are_brought_to_ours() -> None:
    matrix = [[1.0, 0, 0, 100], [0, 1, 0, 200], [0, 0, 1, 300], [0, 0, 0, 1]]
    records = [
        {"position": [100, 200, 300], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True},
        {"matrix": matrix, "outcome": True},
        {"position": "nowhere", "outcome": True},
    ]
    first, second, third = as_stated(records, unit="mm", quaternion_order="wxyz")
    assert first == {**POSE, "position": pytest.approx([0.1, 0.2, 0.3]), "outcome": True}
    assert [row[3] for row in second["matrix"]] == pytest.approx([0.1, 0.2, 0.3, 1])
    # The service names what is no pose.
    assert third == records[2]
    assert records[0]["position"] == [100, 200, 300]
    for wrong in ({"unit": "feet"}, {"quaternion_order": "zyxw"}):
        with pytest.raises(ValueError, match="expected"):
            as_stated(records, **wrong)


def test_shared_values_stay_beside(tmp_path: Path) -> None:
    content = {"gripper": "panda", "trials": [{**POSE, "outcome": True}]}
    assert read_trials(_file(tmp_path, "t.json", content))[1] == {"gripper": "panda"}


def test_ndjson(tmp_path: Path) -> None:
    line = json.dumps({**POSE, "outcome": "missed"})
    assert len(read_trials(_file(tmp_path, "t.ndjson", f"{line}\n\n{line}\n"))[0]) == 2


def test_csv_with_empty_cells_and_a_byte_order_mark(tmp_path: Path) -> None:
    text = f"\ufeff{HEADER}, outcome,width_m,source\n"
    text += ".1,.2,.3,0,0,0,1,success,0.04,robot\n.1,.2,.3,0,0,0,1,false,,\n"
    records, _ = read_trials(_file(tmp_path, "t.csv", text))
    assert records[0] == {**POSE, "outcome": "success", "width_m": 0.04, "source": "robot"}
    assert records[1] == {**POSE, "outcome": False}


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("t.csv", f"{HEADER}\n", "outcome"),
        ("t.csv", f"{HEADER},outcome\n", "no rows"),
        ("t.csv", f"{HEADER},outcome\n1,2,3,0,0,0,1\n", "line 2: the number of cells"),
        ("t.csv", f"{HEADER},outcome\n1,2,3,0,0,0,1,success\n1,2,x,0,0,0,1,success\n", "line 3: z is 'x'"),
        ("t.csv", f"{HEADER},outcome\n1,2,nan,0,0,0,1,success\n", "finite"),
        ("t.csv", f"{HEADER},outcome,colour\n1,2,3,0,0,0,1,success,red\n", "colour"),
        ("t.json", "{", "neither JSON nor NDJSON"),
        ("t.ndjson", json.dumps(POSE) + "\n{\n", "line 2"),
        ("t.json", [1, 2], "JSON objects"),
        ("t.json", {"trials": []}, "no trials"),
        ("t.json", {"columns": {"position": [[0, 0, 0]], "outcome": []}}, "differ in length"),
    ],
)
def test_wrong_files_are_named_with_the_line(tmp_path: Path, name: str, content: object, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as caught:
        read_trials(_file(tmp_path, name, content))
    assert name in str(caught.value)


def test_poses_in_every_form(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = ROW[:3]
    np.save(tmp_path / "p.npy", np.stack([matrix]))
    files = [
        str(tmp_path / "p.npy"),
        _file(tmp_path, "p.csv", f"{HEADER},proposal_density\n{','.join(map(str, ROW))},3\n"),
        _file(tmp_path, "a.json", [POSE]),
        _file(tmp_path, "b.json", {"poses": [POSE]}),
        _file(tmp_path, "c.json", {"position": [ROW[:3]], "quaternion_xyzw": [ROW[3:]]}),
        _file(tmp_path, "d.json", POSE),
        _file(tmp_path, "e.json", [{"matrix": matrix.tolist()}]),
        _file(tmp_path, "f.ndjson", json.dumps(POSE) + "\n"),
        _file(tmp_path, "g.json", [ROW]),
    ]
    for file in files:
        assert np.allclose(read_poses(file), [ROW]), file


def test_wrong_poses_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"pose 1: .*unit quaternion"):
        read_poses(_file(tmp_path, "p.json", [POSE, {**POSE, "quaternion_xyzw": [0, 0, 0, 2]}]))
    with pytest.raises(ValueError, match="has no 'position'"):
        read_poses(_file(tmp_path, "p.json", [{"quaternion_xyzw": [0, 0, 0, 1]}]))


def test_what_other_programs_write(tmp_path: Path) -> None:
    """A byte order mark before JSON; 1.0 and 0.0 where a column of booleans had gaps."""
    marked = tmp_path / "marked.json"
    marked.write_text(json.dumps({"trials": [{"outcome": True}]}), encoding="utf-8-sig")
    assert read_trials(str(marked)) == ([{"outcome": True}], {})
    gaps = tmp_path / "gaps.csv"
    gaps.write_text("x,y,z,qx,qy,qz,qw,outcome\n0,0,0.1,1,0,0,0,1.0\n0,0,0.1,1,0,0,0,0.0\n")
    assert [record["outcome"] for record in read_trials(str(gaps))[0]] == [True, False]


def test_what_is_no_number_or_no_text_is_named(tmp_path: Path) -> None:
    lines = tmp_path / "lines.ndjson"
    lines.write_text('{"outcome": true, "quality": 1}\n{"outcome": true, "quality": NaN}\n')
    with pytest.raises(ValueError, match=r"lines\.ndjson: NaN is no JSON number.*line 2"):
        read_trials(str(lines))
    wide = tmp_path / "wide.csv"
    wide.write_text("x,y,z,qx,qy,qz,qw,outcome\n", encoding="utf-16")
    with pytest.raises(ValueError, match=r"wide\.csv is not UTF-8"):
        read_trials(str(wide))


def test_poses_come_with_the_density_they_were_drawn_with(tmp_path: Path) -> None:
    """As `proposals --csv` and the HTTP interface write them."""
    table = tmp_path / "drawn.csv"
    table.write_text("x,y,z,qx,qy,qz,qw,proposal_density\n0,0,0.1,1,0,0,0,2.5\n0,0,0.2,1,0,0,0,\n")
    columns = tmp_path / "drawn.json"
    rows = {"position": [[0, 0, 0.1], [0, 0, 0.2]], "quaternion_xyzw": [[1, 0, 0, 0]] * 2}
    columns.write_text(json.dumps({**rows, "proposal_density": [2.5, None]}))
    for path in (table, columns):
        drawn = read_drawn_poses(str(path))
        np.testing.assert_array_equal(drawn.position[:, 2], [0.1, 0.2])
        np.testing.assert_array_equal(drawn.proposal_density, [2.5, np.nan])
