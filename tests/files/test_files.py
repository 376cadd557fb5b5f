"""Files of grasps: the record, which files a word means, and our own layout."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from jaxgrasp.files import GraspSet, concatenate, read_grasps, write_grasps
from jaxgrasp.storage import FileError

NAMES = ("a", "b", "c")


def table(count: int = 4, seed: int = 0, names: tuple[str, ...] | None = NAMES) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = {f"{stage}_qpos": rng.normal(size=(count, 10)).astype(np.float32) for stage in ("pregrasp", "grasp")}
    columns |= {"obj_pose": rng.normal(size=(count, 7)), "obj_scale": rng.random(count)}
    columns |= {"succ_flag": rng.random(count) > 0.5, "object_name": np.array(["mug"] * count), "other": np.zeros(9)}
    return columns | ({} if names is None else {"joint_names": np.array(names)})


def same(one: GraspSet, other: GraspSet) -> None:
    assert one.joint_names == other.joint_names and one.stages.keys() == other.stages.keys()
    for name in one.stages:
        assert np.array_equal(one.stages[name].qpos, other.stages[name].qpos)
    for name in ("object_pose", "object_scale", "object_name"):
        assert np.array_equal(getattr(one, name), getattr(other, name))
    assert one.columns.keys() == other.columns.keys()
    for name in one.columns:
        np.testing.assert_array_equal(one.columns[name], other.columns[name])


def test_our_own_files_come_back_as_they_were(tmp_path):
    columns = table()
    np.savez(tmp_path / "in.npz", **columns)
    grasps = read_grasps([tmp_path / "in.npz"])
    assert grasps.joint_names == NAMES and set(grasps.stages) == {"grasp", "pregrasp"} and len(grasps) == 4
    np.testing.assert_array_equal(grasps.stages["grasp"].base, columns["grasp_qpos"][:, :7])
    np.testing.assert_array_equal(grasps.stages["pregrasp"].joints, columns["pregrasp_qpos"][:, 7:])
    assert set(grasps.columns) == {"succ_flag"} and grasps.object_name.tolist() == ["mug"] * 4
    assert grasps.source[3] == f"{tmp_path / 'in.npz'}:3"
    write_grasps(grasps, tmp_path / "out.npz")
    same(read_grasps(str(tmp_path / "out.npz")), grasps)


def test_words_mean_files_folders_and_patterns(tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    for number, folder in enumerate((tmp_path, tmp_path / "deep", tmp_path / "deep" / "er")):
        np.savez(folder / "g[1].npz", **table(2, number))
        (folder / "notes.txt").write_text("")
    everything = read_grasps(tmp_path / "deep")
    assert [text.rpartition("/")[0][len(str(tmp_path)) :] for text in everything.source[::2]] == ["/deep", "/deep/er"]
    assert len(read_grasps([tmp_path / "g[1].npz"])) == 2
    same(read_grasps([f"{tmp_path}/d*/*.npz", tmp_path / "deep" / "er"]), everything)
    with pytest.raises(FileError, match="a pattern that no file fits"):
        read_grasps([f"{tmp_path}/x*.npz"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="a folder without files of grasps"):
        read_grasps([tmp_path / "empty"])
    with pytest.raises(FileError, match="no grasps at all"):
        read_grasps([])


def test_joints_go_by_name_and_columns_that_a_file_lacks_are_unknown(tmp_path):
    first, second = table(2, 0), table(3, 1, NAMES[::-1])
    del second["succ_flag"], second["pregrasp_qpos"]
    second["contacts"] = np.ones((3, 2))
    for name, columns in (("a", first), ("b", second), ("c", table(1, 2, ("a", "b", "x"))), ("d", table(1, 3, None))):
        np.savez(tmp_path / f"{name}.npz", **columns)
    both = read_grasps([tmp_path / "a.npz", tmp_path / "b.npz"])
    assert both.notes == ("pregrasp is left out: 1 of 2 files have it",)
    assert both.joint_names == NAMES and set(both.stages) == {"grasp"}
    np.testing.assert_array_equal(both.stages["grasp"].joints[2:], second["grasp_qpos"][:, :6:-1])
    np.testing.assert_array_equal(np.isnan(both.columns["succ_flag"]), [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(both.columns["contacts"][:2], np.full((2, 2), np.nan))
    with pytest.raises(FileError, match="c.npz: joint_names: got no joint 'c', which .*a.npz has"):
        read_grasps([tmp_path / "a.npz", tmp_path / "c.npz"])
    with pytest.raises(FileError, match="d.npz: joint_names: got no names beside those of .*a.npz"):
        read_grasps([tmp_path / "a.npz", tmp_path / "d.npz"])
    parts = [read_grasps(tmp_path / f"{name}.npz") for name in "ab"]
    same(concatenate(parts), both)


def test_a_bad_file_is_named_or_passed_over(tmp_path):
    np.savez(tmp_path / "a.npz", **table(2))
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-50])
    np.savez(tmp_path / "c.npz", **table(2) | {"joint_names": np.array(["a", "b"])})
    np.savez(tmp_path / "d.npz", **table(2) | {"joint_names": np.array(["a", "b", "b"])})
    np.savez(tmp_path / "e.npz", **table(2) | {"obj_pose": np.zeros((2, 6))})
    np.savez(tmp_path / "f.npz", **table(2) | {"obj_scale": np.array([1.0, 0.0])})
    said: list[str] = []
    assert len(read_grasps(tmp_path, skipped=lambda error: said.append(str(error)))) == 2
    assert [text.split("/")[-1].split(": got")[0] for text in said] == [
        "b.npz",
        "c.npz: grasp_qpos",
        "d.npz: joint_names",
        "e.npz: obj_pose",
        "f.npz: object_scale",
    ]
    with pytest.raises(FileError, match="b.npz: got a truncated .npz file"):
        read_grasps(tmp_path)
    with pytest.raises(ValueError, match="format: got 'nix', wanted one of .*jaxgrasp"):
        read_grasps(tmp_path, "nix")
    with pytest.raises(ValueError, match="format: got 'nix', wanted one of .*jaxgrasp"):
        write_grasps(read_grasps(tmp_path / "a.npz"), tmp_path / "x", "nix")


def flat(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    found = {}
    for name, column in columns.items():
        found |= {f"{name}_{k}": column[:, k] for k in range(column.shape[1])} if column.ndim > 1 else {name: column}
    return found


@pytest.mark.parametrize("kind", ["parquet", "flat.parquet", "csv", "h5"])
def test_tables_say_the_same_as_archives(kind, tmp_path):
    columns = {name: x for name, x in table().items() if name != "other"}
    np.savez(tmp_path / "in.npz", **columns)
    path = tmp_path / f"in.{kind}"
    names = columns.pop("joint_names")
    if kind == "h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            for name, column in (columns | {"joint_names": names}).items():
                file[name] = column.astype(object) if column.dtype.kind == "U" else column
    elif kind == "parquet":
        lists = {name: column.tolist() for name, column in columns.items()}
        parquet.write_table(pa.table(lists | {"joint_names": [names.tolist()] * 4}), path)
    else:
        rows = pa.table(flat(columns) | {"joint_names": np.array([";".join(names)] * 4)})
        csv.write_csv(rows, path) if kind == "csv" else parquet.write_table(rows, path)
    ours, theirs = read_grasps(tmp_path / "in.npz"), read_grasps(path)
    assert theirs.joint_names == ours.joint_names and theirs.columns.keys() == ours.columns.keys()
    for name in ours.stages:
        np.testing.assert_allclose(theirs.stages[name].qpos, ours.stages[name].qpos, rtol=1e-6)
    np.testing.assert_array_equal(theirs.object_name, ours.object_name)
    np.testing.assert_array_equal(theirs.columns["succ_flag"], ours.columns["succ_flag"])
    np.testing.assert_allclose(theirs.object_scale, ours.object_scale)
