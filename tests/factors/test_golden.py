# SPDX-License-Identifier: BSD-3-Clause
"""Reference values computed in 50-digit arithmetic, and what happens when their files are damaged."""

import json
import shutil
from pathlib import Path

import pytest

from groma.errors import FileFormatError, InputError
from groma.factors.checks.golden import FILES, check_golden

pytestmark = pytest.mark.kernels

GOLDEN = Path(__file__).resolve().parents[1] / "data" / "golden"
BLOCKS = {
    "point": {"residual", "pose_left", "pose_right", "point", "intrinsics"},
    "line_endpoint": {"residual", "pose_left", "pose_right", "line_left", "line_right", "line_plucker", "intrinsics"},
    "line_normal": {
        "residual",
        "body_left",
        "body_right",
        "extrinsics_left",
        "extrinsics_right",
        "line_left",
        "line_right",
    },
    "plane_quaternion": {"residual", "pose_left", "pose_right", "plane_left", "plane_right"},
}


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "golden")
    return tmp_path / "golden"


def change(path: Path, edit) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def test_all_blocks_of_all_cases_agree():
    rows = check_golden(GOLDEN)
    assert {name: {row.block for row in rows if row.factor == name} for name in FILES} == BLOCKS
    for row in rows:
        assert row.cases == 26
        assert row.passed, row
        assert row.worst < 0.1, row  # a margin of ten, so that other processors agree too


@pytest.mark.shared
def test_values_beside_the_checkout_agree(shared_golden):
    assert all(row.passed for row in check_golden(shared_golden))


@pytest.mark.parametrize("name", list(FILES))
def test_a_wrong_number_is_noticed(folder, name):
    def edit(content):
        block = "pose_left" if name != "line_normal" else "body_left"
        matrix = content["cases"][3]["jacobians"][block]
        largest = max(range(6), key=lambda j: abs(float(matrix[1][j])))
        matrix[1][largest] = repr(float(matrix[1][largest]) * (1 + 1e-7))

    change(folder / f"{name}.json", edit)
    failed = [row for row in check_golden(folder) if not row.passed]
    assert [(row.factor, row.worst_case[-3:]) for row in failed] == [(name, "003")]


def test_fewer_cases_and_blocks_are_fine(folder):
    def edit(content):
        content["cases"] = content["cases"][5:7]
        del content["cases"][0]["jacobians"]["point"]

    change(folder / "point.json", edit)
    rows = {row.block: row for row in check_golden(folder) if row.factor == "point"}
    assert rows["point"].cases == 1 and rows["residual"].cases == 2
    assert all(row.passed for row in rows.values())


def test_quaternions_and_planes_need_not_be_unit(folder):
    def edit(content):
        for case in content["cases"]:
            for name in ("q_CW", "pi_C", "pi_W"):
                case["inputs"][name] = [repr(4.0 * float(number)) for number in case["inputs"][name]]

    change(folder / "plane_quaternion.json", edit)
    assert all(row.passed for row in check_golden(folder))


def test_missing_folder_and_files(tmp_path, folder):
    with pytest.raises(InputError, match=r"missing: point\.json, line_endpoint\.json"):
        check_golden(tmp_path / "nowhere")
    (folder / "line_normal.json").unlink()
    with pytest.raises(InputError, match=r"missing: line_normal.json\. Check the path"):
        check_golden(folder)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.999])
def test_truncated_file(folder, share):
    path = folder / "point.json"
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(FileFormatError, match=r"point\.json must be a JSON file"):
        check_golden(folder)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"[" * 100000, b"[]", b"{}", b"null", b"3"])
def test_file_of_something_else(folder, content):
    (folder / "point.json").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"point\.json"):
        check_golden(folder)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c.update(schema="golden-factor-9"), "schema must be"),
        (lambda c: c.update(factor="line"), "factor must be 'point'"),
        (lambda c: c.update(cases=[]), "at least one case"),
        (lambda c: c.update(cases={}), "'cases' of type list; got a dict"),
        (lambda c: c["cases"].append(7), "'id' of type str; got nothing"),
        (lambda c: c["cases"][2].pop("inputs"), "point-002 must have a field 'inputs'"),
        (lambda c: c["cases"][2].pop("noise"), "'noise' of type dict; got nothing"),
        (lambda c: c["cases"][2].pop("residual"), r"point-002: residual must hold finite numbers of shape \(2,\)"),
        (lambda c: c["cases"][2]["inputs"].pop("uv"), r"point-002: uv must hold finite numbers of shape \(2,\)"),
        (lambda c: c["cases"][2]["inputs"]["uv"].append("1"), r"got shape \(3,\)"),
        (lambda c: c["cases"][2]["inputs"].update(uv=["1", "x"]), "could not convert"),
        (lambda c: c["cases"][2]["inputs"].update(uv=["1", "nan"]), "not finite"),
        (lambda c: c["cases"][2]["inputs"].update(uv=["1", ["2"]]), "finite numbers"),
        (lambda c: c["cases"][2]["jacobians"]["point"].pop(), r"point-002: point must hold .* \(2, 3\)"),
        (lambda c: c["cases"][2]["jacobians"].update(poses=[["1"]]), "lists the block 'poses'; known are residual"),
        (lambda c: c["cases"][2]["noise"].update(point="?"), "noise of point"),
    ],
)
def test_damaged_content(folder, edit, message):
    change(folder / "point.json", edit)
    with pytest.raises(FileFormatError, match=message):
        check_golden(folder)
