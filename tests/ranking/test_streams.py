"""Rankings in parts: the same answers as in memory, from files of every kind, and on from wherever they ended."""

import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet
import pytest

import jaxgrasp as jg
from benchmarks.assaults import resumed
from jaxgrasp.candidates import Candidates, concatenate, read_candidates, sample_grasps
from jaxgrasp.candidates.arrow import candidates_of_table, table_of_candidates
from jaxgrasp.cli import main
from jaxgrasp.ranking import TableRanker, rank, rank_batches
from jaxgrasp.ranking.order import best_of, order_of
from jaxgrasp.ranking.sketch import Sketch
from jaxgrasp.ranking.streams import plan
from jaxgrasp.ranking.streams.inputs import names_of, sources_of
from jaxgrasp.ranking.streams.sources import Given, rows_from
from jaxgrasp.storage import FileError, limited_to

TOP = 8
# Tiles of other sizes may stop at other last digits.
CLOSE = {"rtol": 1e-7, "atol": 1e-7}


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(path, count=40, seed=0, **changes) -> Path:
    """An archive, or by its ending a file of Parquet or Arrow, of sampled grasps."""
    grasps = sample_grasps(count, seed=seed)
    fields = {
        "positions": grasps.positions,
        "outward_normals": grasps.normals,
        "friction": grasps.friction,
        "max_force": grasps.max_force,
        "name": np.array([f"{seed}-{row}" for row in range(count)]),
    }
    fields = {name: value for name, value in (fields | changes).items() if value is not None}
    if path.suffix == ".npz":
        np.savez(path, **fields)
        return path
    table = table_of_candidates(grasps).append_column("name", pa.array(fields["name"]))
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(table, path, row_group_size=15)
    else:
        pyarrow.feather.write_feather(table, path, chunksize=15)
    return path


def ran(*arguments) -> int:
    return main(["rank", *map(str, arguments)])


def rows_of(folder) -> pa.Table:
    return pyarrow.parquet.read_table(Path(folder) / "parts")


def same_as_in_memory(folder, files, top=TOP, **options) -> None:
    """Whether the parts have every candidate once, in order, and the best are those of a ranking in memory."""
    candidates = read_candidates(files)
    ranking = rank(candidates, top=top, **options)
    rows = rows_of(folder)
    np.testing.assert_array_equal(rows["index"], candidates.index)
    assert rows["source"].to_pylist() == [candidates.sources[number] for number in candidates.source]
    assert rows["name"].to_pylist() == candidates.columns["name"].tolist()
    np.testing.assert_allclose(rows["margin"], ranking.margin, **CLOSE)
    best = pyarrow.parquet.read_table(Path(folder) / "top.parquet")
    order = ranking.order[:top]
    assert best["name"].to_pylist() == candidates.columns["name"][order].tolist()
    np.testing.assert_allclose(best["effort"], ranking.effort, rtol=1e-6)
    np.testing.assert_array_equal(best["rank"], np.arange(1, top + 1))


def test_a_folder_has_what_a_table_has(here, capsys):
    files = [write(here / f"{seed}.npz", count=30 + seed, seed=seed) for seed in range(3)]
    assert ran(*files, "--run", "found", "--top", TOP, "--part-size", 25, "--sorted") == 0
    printed = capsys.readouterr().out
    assert "93 SOLVED" in printed and "written: found/parts, found/top.parquet, found/sorted.parquet" in printed
    assert len(list((here / "found" / "parts").iterdir())) == 4
    same_as_in_memory("found", files)
    whole, rows = pyarrow.parquet.read_table("found/sorted.parquet"), rows_of("found")
    order = np.lexsort([-rows["margin"].to_numpy()])
    np.testing.assert_array_equal(whole["rank"], np.arange(1, 94))
    assert whole["name"].to_pylist() == [rows["name"][int(row)].as_py() for row in order]
    assert (here / "found" / "ranking.png").read_bytes().startswith(b"\x89PNG")
    assert not (here / "ranking.png").exists() and not (here / "found" / ".sorting").exists()


def test_above_a_number_a_table_becomes_a_folder(here, capsys, monkeypatch):
    monkeypatch.setattr("jaxgrasp.cli.rank_in_parts.MOST_IN_A_TABLE", 20)
    write(here / "a.npz")
    assert ran("a.npz", "--figure", "None", "--output", "many.parquet") == 0
    assert "40 candidates: the result is a folder, many" in capsys.readouterr().err
    assert rows_of("many").num_rows == 40
    assert ran("a.npz", "--figure", "None", "--output", "None") == 2
    assert "wanted --run FOLDER for more than 20" in capsys.readouterr().err


def test_pruned_and_other_metrics(here, capsys):
    files = [write(here / f"{seed}.npz", seed=seed) for seed in range(3)]
    assert ran(*files, "--run", "pruned", "--prune", "--top", TOP, "--part-size", 64) == 0
    assert ran(*files, "--run", "plain", "--top", TOP, "--part-size", 64) == 0
    best = [pyarrow.parquet.read_table(f"{folder}/top.parquet") for folder in ("pruned", "plain")]
    assert best[0]["name"] == best[1]["name"]
    assert "PRUNED" in rows_of("pruned")["status"].to_pylist()
    assert ran(*files, "--run", "other", "--metric", "isotropy", "--top", 3, "--sorted") == 0
    rows = rows_of("other")
    wanted = np.sort(rows["isotropy"].to_numpy())[::-1]
    np.testing.assert_array_equal(pyarrow.parquet.read_table("other/top.parquet")["isotropy"], wanted[:3])
    np.testing.assert_array_equal(pyarrow.parquet.read_table("other/sorted.parquet")["isotropy"], wanted)


def test_folders_patterns_and_all_kinds_of_files(here, capsys):
    (here / "in" / "deeper").mkdir(parents=True)
    write(here / "in" / "a.npz", seed=0)
    write(here / "in" / "b.parquet", seed=1)
    write(here / "in" / "deeper" / "c.feather", seed=2)
    (here / "in" / "notes.txt").write_text("nothing")
    assert ran("in", "--run", "all", "--top", TOP, "--part-size", 33) == 0
    assert ran("in/*.*z", "in/b.parquet", "in/deeper", "--run", "each", "--top", TOP) == 0
    rows = rows_of("all")
    assert rows["name"].to_pylist() == [f"{seed}-{row}" for seed in range(3) for row in range(40)]
    np.testing.assert_allclose(rows_of("each")["margin"], rows["margin"], **CLOSE)
    # In memory, too.
    assert ran("in", "--top", TOP, "--figure", "None") == 0
    table, best = pyarrow.parquet.read_table("ranking.parquet"), pyarrow.parquet.read_table("all/top.parquet")
    assert table["name"].to_pylist()[:TOP] == best["name"].to_pylist()


def test_folders_that_stand_for_columns(here, capsys):
    for place in ("hand=shadow/object=a%20can", "hand=allegro"):
        (here / "in" / place).mkdir(parents=True)
        write(here / "in" / place / "a.npz", seed=len(place))
    write(here / "in" / "hand=allegro" / "b.parquet")
    assert ran("in", "--run", "found", "--top", TOP) == 0
    rows = rows_of("found")
    assert rows["hand"].to_pylist() == 80 * ["allegro"] + 40 * ["shadow"]
    assert rows["object"].to_pylist() == 80 * [None] + 40 * ["a can"]
    assert ran("in", "--output", "all.csv", "--figure", "None") == 0
    assert ran("in/hand=shadow", "--output", "one.parquet", "--figure", "None") == 0
    assert set(pyarrow.parquet.read_table("one.parquet")["hand"].to_pylist()) == {"shadow"}
    # Files that have no other columns.
    bare = here / "bare" / "hand=allegro"
    bare.mkdir(parents=True)
    write(bare / "a.npz", name=None)
    named = pyarrow.parquet.read_table(write(bare / "b.parquet"))
    pyarrow.parquet.write_table(named.drop_columns("name"), bare / "b.parquet")
    assert ran("bare", "--run", "of_bare", "--top", TOP) == 0
    assert rows_of("of_bare")["hand"].to_pylist() == 80 * ["allegro"]


def test_urls(here, capsys):
    fsspec = pytest.importorskip("fsspec")
    with fsspec.open("memory://grasps/a.npz", "wb") as stream:
        stream.write(write(here / "a.npz").read_bytes())
    with fsspec.open("memory://grasps/b.parquet", "wb") as stream:
        stream.write(write(here / "b.parquet", seed=1).read_bytes())
    assert ran("memory://grasps", "--run", "found", "--top", 4) == 0
    assert rows_of("found").num_rows == 80
    assert set(rows_of("found")["source"].to_pylist()) == {"memory://grasps/a.npz", "memory://grasps/b.parquet"}
    assert ran(f"file://{here}/a.n*", "--run", "other", "--top", 4) == 0
    assert rows_of("other").num_rows == 40
    assert ran("memory://nowhere", "--run", "none") == 2
    assert "memory://nowhere: got" in capsys.readouterr().err


def test_a_server_of_objects(here, monkeypatch):
    moto, boto3 = pytest.importorskip("moto.server"), pytest.importorskip("boto3")
    server = moto.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        for name, value in {
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        }.items():
            monkeypatch.setenv(name, value)
        client = boto3.client("s3")
        client.create_bucket(Bucket="grasps")
        for name in ("a.npz", "b.parquet", "c.feather"):
            client.upload_file(str(write(here / name, seed=ord(name[0]))), "grasps", f"in/{name}")
        assert ran("s3://grasps/in", "--run", "found", "--top", TOP, "--part-size", 50) == 0
        assert ran("a.npz", "b.parquet", "c.feather", "--run", "local", "--top", TOP, "--part-size", 50) == 0
        assert ran("s3://grasps/in/*.parquet", "--top", TOP, "--figure", "None") == 0
    finally:
        server.stop()
    names = ["index", "margin", "upper_bound", "status", "name"]
    assert rows_of("found").select(names).equals(rows_of("local").select(names))
    assert set(rows_of("found")["source"].to_pylist()) == {
        f"s3://grasps/in/{name}" for name in ("a.npz", "b.parquet", "c.feather")
    }
    assert pyarrow.parquet.read_table("ranking.parquet").num_rows == 40


def test_a_bad_file_among_others(here, capsys):
    write(here / "a.npz")
    (here / "b.npz").write_bytes(b"PK\x03\x04 nothing")
    damaged = write(here / "c.npz", count=400, seed=2).read_bytes()
    place = damaged.index(sample_grasps(400, seed=2).positions[300, 0].tobytes())
    (here / "c.npz").write_bytes(damaged[:place] + b"\0\0\0" + damaged[place + 3 :])
    write(here / "d.npz", seed=3)
    assert ran("*.npz", "--run", "none") == 2
    assert "b.npz: got a truncated .npz file" in capsys.readouterr().err
    assert not (here / "none").exists()
    assert ran("*.npz", "--run", "found", "--keep-going", "--top", 4) == 2
    printed = capsys.readouterr()
    assert "b.npz: got a truncated" in printed.err and "c.npz: positions: got damaged data" in printed.err
    assert "400 of 480 candidates could not be read" in printed.err
    assert "80 SOLVED" in printed.out
    assert set(rows_of("found")["source"].to_pylist()) == {"a.npz", "d.npz"}


def test_grasps_with_other_numbers_of_contacts(here):
    grasps = [sample_grasps(20, seed=seed) for seed in range(2)]
    fewer = replace(grasps[1], **{
        name: getattr(grasps[1], name)[:, :3]
        for name in ("positions", "outward_normals", "friction", "max_force", "active")
    })  # fmt: skip
    rows = table_of_candidates(grasps[0]).to_pylist() + table_of_candidates(fewer).to_pylist()
    order = np.random.default_rng(0).permutation(40)
    table = pa.Table.from_pylist([rows[row] for row in order])
    found, travelling = candidates_of_table(table, "mixed")
    assert found.positions.shape == (40, 4, 3) and travelling.num_columns == 0
    np.testing.assert_array_equal(found.active.sum(1), np.where(order < 20, 4, 3))
    margins = rank(concatenate([grasps[0], fewer]), top=0).margin[order]
    (answer,) = rank_batches([table])
    np.testing.assert_allclose(answer["margin"], margins, **CLOSE)
    np.savez(here / "a.npz", **fields_of(grasps[0]))
    np.savez(here / "b.npz", **fields_of(fewer))
    assert ran("a.npz", "b.npz", "--run", "found", "--top", 4, "--part-size", 15) == 0
    np.testing.assert_allclose(np.array(rows_of("found")["margin"])[order], margins, **CLOSE)


def fields_of(grasps: Candidates) -> dict[str, np.ndarray]:
    names = ("positions", "outward_normals", "friction", "max_force")
    return {name: getattr(grasps, name) for name in names}


def test_tables_in_and_out():
    grasps = sample_grasps(50)
    table = table_of_candidates(grasps).append_column("when", pa.array([None] * 50, pa.timestamp("s")))
    spoilt = table.to_pylist()
    spoilt[3]["positions"] = None
    spoilt[4]["friction"] = [None] * 4
    table = pa.Table.from_pylist(spoilt, schema=table.schema)
    ranker = pickle.loads(pickle.dumps(TableRanker(gravity=9.81, metrics=["isotropy"])))
    found = pa.concat_tables(map(ranker, (table.slice(0, 20), table.slice(20).to_batches()[0])))
    ranking = rank(grasps, gravity=9.81, top=0)
    good = [row for row in range(50) if row not in (3, 4)]
    np.testing.assert_allclose(np.array(found["margin"])[good], ranking.margin[good], **CLOSE)
    assert [found["status"][row].as_py() for row in (3, 4)] == ["INVALID_INPUT"] * 2
    assert found.select(table.column_names) == table and found.column_names[-1] == "isotropy"
    assert ranker(table.slice(0, 0)).num_rows == 0
    # Again, and nothing is there twice.
    assert ranker(found).column_names == found.column_names
    with pytest.raises(ValueError, match="table: outward_normals: got no such column"):
        ranker(table.drop_columns(["outward_normals"]))
    with pytest.raises(ValueError, match="table: friction: got 3 contacts in row 0; wanted 4 as in positions"):
        ranker(table.set_column(1, "friction", pa.array([[0.5] * 3] * 50)))


def test_arrays_of_other_libraries_are_shared():
    pointer = lambda x: np.from_dlpack(x).ctypes.data
    grasps = sample_grasps(64)
    frames = np.asarray(jg.Contacts.from_normals(grasps.positions, grasps.normals, friction=0.5, max_force=1.0).frames)
    given = [aligned(x) for x in (grasps.positions, frames, grasps.friction)]
    contacts = jg.Contacts.from_dlpack(*given[:2], friction=given[2], max_force=2.0)
    for ours, theirs in zip((contacts.positions, contacts.frames, contacts.friction), given, strict=True):
        assert pointer(ours) == theirs.ctypes.data
    margin = jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0)).margin
    assert pointer(margin) == margin.unsafe_buffer_pointer()
    with pytest.raises(ValueError, match=r"friction: got float64 \(64, 3\), wanted float64 \(64, 4\)"):
        jg.Contacts.from_dlpack(*given[:2], friction=given[2][:, :3].copy(), max_force=2.0)


def aligned(x: np.ndarray) -> np.ndarray:
    """The same, at an address that JAX does not copy from."""
    room = np.empty(x.nbytes + 64, np.uint8)
    start = -room.ctypes.data % 64
    found = room[start : start + x.nbytes].view(x.dtype).reshape(x.shape)
    found[:] = x
    return found


def test_a_run_goes_on(here, capsys):
    files = [write(here / f"{seed}.npz", seed=seed) for seed in range(3)]
    assert ran(*files, "--run", "found", "--top", TOP, "--part-size", 25) == 0
    first = rows_of("found")
    parts = sorted((here / "found" / "parts").iterdir())
    parts[1].unlink()
    parts[3].write_bytes(parts[3].read_bytes()[:-100])
    (here / "found" / "summaries" / "part-000004.arrow").write_bytes(b"nothing")
    kept = parts[0].stat().st_mtime_ns
    capsys.readouterr()
    (here / "elsewhere").mkdir()
    os.chdir(here / "elsewhere")
    assert ran("--resume", "../found") == 0
    assert "120 SOLVED" in capsys.readouterr().out
    assert parts[0].stat().st_mtime_ns == kept
    assert rows_of("../found").equals(first)
    os.chdir(here)
    same_as_in_memory("found", files)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--top", "3"], "--top: got 3; the run has 8"),
        (["--gravity", "1"], "--gravity: got 1.0; the run has 0.0"),
        (["--disturbances", "ball"], "--disturbances: got ball; the run has forces"),
        (["--part-size", "10"], "--part-size: got 10; the run has 25"),
        (["a.npz"], "inputs: got 1 files; the run has 2"),
        (["b.npz", "a.npz"], "b.npz: got another file; the run has a.npz"),
    ],
)
def test_another_run_is_refused(begun, capsys, options, words):
    assert ran("--resume", "found", *options) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and f"--resume found: {words}" in line


def test_a_file_that_changed_is_refused(begun, capsys):
    write(begun / "b.npz", seed=7)
    assert ran("--resume", "found") == 2
    assert "b.npz: got a file that has changed (digest)" in capsys.readouterr().err


def test_folders_that_cannot_be_used(begun, capsys):
    assert ran("a.npz", "--run", "found") == 2
    assert "found: got the folder of a run; wanted a new one, or --resume found" in capsys.readouterr().err
    assert ran("--resume", "nowhere") == 2
    assert "--resume: nowhere/manifest.json: got no such file" in capsys.readouterr().err
    manifest = begun / "found" / "manifest.json"
    whole = manifest.read_bytes()
    for content in (b"[]", whole[:-1], whole.replace(b'"rows"', b'"rowz"'), whole.replace(b"null", b"true", 1)):
        assert content != whole
        manifest.write_bytes(content)
        assert ran("--resume", "found") == 2
        assert "manifest.json: got no manifest, or a damaged one" in capsys.readouterr().err


@pytest.fixture
def begun(here, capsys) -> Path:
    """A run that is not done yet."""
    for seed, name in enumerate("ab"):
        write(here / f"{name}.npz", seed=seed)
    assert ran("a.npz", "b.npz", "--run", "found", "--top", TOP, "--part-size", 25, "--figure", "None") == 0
    (here / "found" / "parts" / "part-000001.parquet").unlink()
    capsys.readouterr()
    return here


def test_a_full_disk(here, capsys, monkeypatch):
    write(here / "a.npz")
    from jaxgrasp.ranking.streams.folder import Parts

    wanted = Parts.write

    def fail(self, number, *rest):
        if number == 1:
            raise OSError(28, "No space left on device")
        wanted(self, number, *rest)

    monkeypatch.setattr(Parts, "write", fail)
    assert ran("a.npz", "--run", "found", "--part-size", 15, "--top", TOP) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "found: cannot be written (no space left on device); jaxgrasp rank --resume found goes on" in line
    monkeypatch.setattr(Parts, "write", wanted)
    assert ran("--resume", "found") == 0
    same_as_in_memory("found", ["a.npz"])


def test_two_at_once_are_refused(begun, capsys):
    from jaxgrasp.ranking.streams.run import held

    with held(begun / "found"):
        assert ran("--resume", "found") == 2
    assert "found: cannot be used (another process is at work on it)" in capsys.readouterr().err


@pytest.mark.thorough
def test_killed_it_goes_on(tmp_path):
    found = resumed.killed(tmp_path, kills=5, rows=4_000, seed=0)
    assert found["kills"] == 5 and found["runs that were ended by --resume"] >= 1


def test_the_best_without_sorting_the_others():
    draw = np.random.default_rng(0)
    for _ in range(50):
        margin = draw.integers(0, 20, 60) / 4.0
        status = draw.choice(len(jg.Status), 60)
        margin[status == jg.Status.INVALID_INPUT] = np.nan
        for top in (0, 1, 5, 59, 60, 80):
            np.testing.assert_array_equal(best_of(margin, status, {}, top), order_of(margin, status, {})[:top])


def test_sketches_add_up():
    draw = np.random.default_rng(0)
    margin, status = np.exp(draw.normal(size=5_000)) * (draw.random(5_000) > 0.2), draw.choice(3, 5_000)
    whole = Sketch.of(margin, status)
    parts = Sketch.sum([Sketch.of(margin[a : a + 700], status[a : a + 700]) for a in range(0, 5_000, 700)])
    read = Sketch.from_json(parts.to_json())
    np.testing.assert_array_equal(read.margins, whole.margins)
    np.testing.assert_array_equal(read.statuses, np.bincount(status, minlength=len(jg.Status)))
    positive = margin[(status == jg.Status.SOLVED) & (margin > 0)]
    assert whole.positive == len(positive) and whole.count == 5_000
    np.testing.assert_allclose(whole.median, np.median(positive), rtol=3e-3)


def test_parts_divide_files(here):
    for seed, count in enumerate((7, 1, 30, 12)):
        write(here / f"{seed}.npz", count=count, seed=seed)
    given = Given()
    sources = sources_of(names_of(["."]), given)
    reader = plan.PartReader(sources, plan.schema_of(sources), given)
    whole = read_candidates([source.name for source in sources])
    parts = plan.parts_of(sources, 9, 10**9)
    read = [reader.read(part) for part in parts]
    reader.close()
    assert [len(found[0]) for found in read] == [9, 9, 9, 9, 9, 5]
    np.testing.assert_array_equal(np.concatenate([found[0].positions for found in read]), whole.positions)
    small = plan.parts_of(sources, 1_000, 4 * sources[0].row_size)
    assert max(sum(s.stop - s.start for s in part) for part in small) == 4
    assert sum(s.stop - s.start for part in small for s in part) == 50


def test_rows_from_the_middle_of_a_large_file(here):
    # More bytes lie before them than are read at once.
    positions = np.random.default_rng(0).normal(size=(60_000, 4, 3))
    np.savez(here / "a.npz", positions=positions, outward_normals=np.ones_like(positions))
    (source,) = sources_of(["a.npz"], Given(friction=1.0, max_force=1.0))
    with rows_from(source, 50_000, Given(friction=1.0, max_force=1.0)) as rows:
        np.testing.assert_array_equal(rows.read(5)[0].positions, positions[50_000:50_005])


def test_a_file_above_the_budget_is_read_in_parts(here, capsys):
    path = write(here / "a.npz", count=400)
    limit = path.stat().st_size // 2
    with limited_to(limit):
        with pytest.raises(FileError, match="--read-limit"):
            read_candidates([path])
    assert ran(path, "--run", "found", "--read-limit", limit / 2**30, "--top", TOP) == 0
    assert len(list((here / "found" / "parts").iterdir())) > 4
    assert json.loads((here / "found" / "manifest.json").read_text())["inputs"][0]["rows"] == 400
