"""kill -9 at random moments of every writer, and many writers of one file: the old file or a new one, always whole.

python -m benchmarks.assaults.killed [--count 30] [--rows 150000] [--output killed.md]
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyarrow.parquet

from jaxgrasp.candidates import Candidates
from jaxgrasp.evaluation import Evaluation, write_evaluation
from jaxgrasp.files import GraspSet, read_grasps, write_grasps
from jaxgrasp.files.grasp_set import HandPoses
from jaxgrasp.ranking import Ranking, write_table
from jaxgrasp.simulation import protocol_named
from jaxgrasp.storage import atomic_write
from jaxgrasp.viewer import figure_of_ranking, write_figure

OLD = b"an old file, worth keeping"


def ranking(count: int, factor: float = 1.0) -> Ranking:
    draw = np.random.default_rng(0)
    positions, margin = draw.normal(size=(count, 4, 3)), factor * draw.random(count)
    candidates = Candidates(
        positions=positions,
        outward_normals=positions,
        friction=np.full((count, 4), 0.6),
        max_force=np.full((count, 4), 10.0),
        active=np.ones((count, 4), bool),
        mass=np.full(count, 0.1),
        columns={"name": np.full(count, "thing"), "x": draw.normal(size=count)},
        sources=("a.npz",),
        source=np.zeros(count, np.int32),
        index=np.arange(count),
    )
    return Ranking(
        candidates=candidates,
        margin=margin,
        upper_bound=margin,
        status=np.zeros(count, int),
        order=np.argsort(-margin),
        share=0.75,
        forces=np.zeros((10, 4, 3)),
        object_forces=np.zeros((10, 4, 3)),
        effort=np.zeros(10),
        tightening_status=np.zeros(10, int),
        controls=np.zeros((10, 0)),
    )


def grasp_set(count: int) -> GraspSet:
    draw = np.random.default_rng(1)
    standing = np.tile([0.0, 0, 0, 1, 0, 0, 0], (count, 1))
    poses = HandPoses(base=standing, joints=draw.normal(size=(count, 20)))
    return GraspSet(
        stages={"grasp": poses, "squeeze": poses},
        joint_names=tuple(f"joint{k}" for k in range(20)),
        object_pose=standing,
        object_scale=np.full(count, 0.1),
        object_name=np.full(count, "thing"),
        source=np.array([f"a.npz:{row}" for row in range(count)]),
        columns={"margin": draw.random(count), "forces": draw.normal(size=(count, 5, 3))},
    )


def evaluation(grasps: GraspSet) -> Evaluation:
    draw, count = np.random.default_rng(2), len(grasps)
    numbers = ("delta_pos", "delta_angle", "penetration", "self_penetration", "contact_distance", "contact_consistency")
    return Evaluation(
        protocol=protocol_named("dexgraspbench-fc"),
        grasps=grasps,
        object=grasps.object_name,
        outcome=np.full(count, "held"),
        held=np.ones(count, bool),
        contact_number=np.full(count, 4),
        loads=np.ones((count, 6), int),
        said=(),
        interrupted=False,
        **{name: draw.random(count) for name in numbers},
    )


def column(path: Path, name: str) -> np.ndarray:
    if path.suffix == ".npz":
        with np.load(path) as archive:
            return archive[name]
    read = pyarrow.parquet.read_table if path.suffix == ".parquet" else pyarrow.csv.read_csv
    return read(path)[name].to_numpy()


def margins_of(path: Path) -> np.ndarray:
    return column(path, "margin")


def writers(rows: int) -> dict[str, tuple[str, Callable[[Path], None], Callable[[Path], bool]]]:
    """Ending, what writes, and whether a file is whole, by name."""
    table, best = ranking(rows), np.sort(ranking(rows).margin)[::-1]

    def candidates(path: Path) -> None:
        with atomic_write(path) as stream:
            np.savez(stream, positions=table.candidates.positions, margin=table.margin)

    def kernel(path: Path) -> None:
        from jaxgrasp.kernels.store import folder

        os.environ["XDG_CACHE_HOME"] = str(path.parents[2])
        folder.keep(path.name, bytes(40_000_000))

    def read_kernel(path: Path) -> bool:
        from jaxgrasp.kernels.store import folder

        os.environ["XDG_CACHE_HOME"] = str(path.parents[2])
        return folder.read(path.name) == bytes(40_000_000)

    def picture(path: Path) -> None:
        write_figure(figure_of_ranking(table), path)

    def same(path: Path) -> bool:
        return np.array_equal(margins_of(path), best)

    def ends(path: Path) -> bool:
        return path.read_bytes().endswith(b"IEND\xaeB`\x82")

    def write(path: Path) -> None:
        write_table(table, path)

    grasps = grasp_set(rows // 50)
    tried = evaluation(grasps)

    def same_grasps(path: Path) -> bool:
        return np.array_equal(read_grasps(path).stages["grasp"].joints, grasps.stages["grasp"].joints)

    def trials(path: Path) -> None:
        write_evaluation(tried, path)

    def folder(path: Path) -> None:
        write_grasps(grasps.take(np.arange(200)), path.parent, "dexgraspbench")

    def same_rows(path: Path) -> bool:
        """Each file there is that of its row."""
        files = [file for file in path.parent.glob("*.npy") if file.read_bytes() != OLD]
        joints = grasps.stages["grasp"].joints
        return all(np.allclose(read_grasps(f).stages["grasp"].joints[0], joints[int(f.stem)]) for f in files)

    found = {f"table {ending}": (ending, write, same) for ending in (".parquet", ".csv", ".npz")}
    found["candidates .npz"] = (".npz", candidates, lambda path: np.array_equal(margins_of(path), table.margin))
    found["figure .png"] = (".png", picture, ends)
    found["grasps .npz"] = (".npz", lambda path: write_grasps(grasps, path), same_grasps)
    found["grasps .yaml"] = (".yaml", lambda path: write_grasps(grasps, path, "isaac_grasp"), same_grasps)
    found["folder of 200 grasps"] = ("000.npy", folder, same_rows)
    for ending in (".parquet", ".csv", ".npz"):
        found[f"trials {ending}"] = (
            ending,
            trials,
            lambda path: np.array_equal(column(path, "delta_pos"), tried.delta_pos),
        )
    found["kernel on disk"] = ("", kernel, read_kernel)
    return found


def forked(job: Callable[[], None]) -> int:
    child = os.fork()
    if child == 0:
        try:
            job()
            os._exit(0)
        finally:
            os._exit(1)
    return child


def killed(name: str, rows: int, count: int, folder: Path, draw: random.Random) -> str:
    ending, write, is_whole = writers(rows)[name]
    # As deep as the folder of kernels, and trusted as it is.
    home = folder / name.replace(" ", "_") / "jaxgrasp" / "kernels"
    home.mkdir(mode=0o700, parents=True)
    path = home / (ending if ending[:1].isdigit() else f"file{ending}")
    lengths = []
    # The first one may take long for other reasons.
    for _ in range(3):
        begun = time.perf_counter()
        os.waitpid(forked(lambda: write(path)), 0)
        lengths.append(time.perf_counter() - begun)
    length = min(lengths)
    assert is_whole(path), name
    outcomes = {"old": 0, "new": 0, "broken": 0, "gone": 0}
    littered = 0
    for _ in range(count):
        for made in home.glob("[!.]*"):
            made.unlink()
        path.write_bytes(OLD)
        child = forked(lambda: write(path))
        time.sleep(draw.uniform(0.0, 1.1 * length))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        littered += any(home.glob(".*"))
        if not path.exists():
            outcomes["gone"] += 1
        elif path.read_bytes() == OLD:
            outcomes["old"] += 1
        else:
            outcomes["new" if is_whole(path) else "broken"] += 1
    os.waitpid(forked(lambda: write(path)), 0)
    left = len(list(home.glob(".*")))
    cells = [f"{length:.2f}", count, *outcomes.values(), littered, left]
    return f"| {name} | {' | '.join(map(str, cells))} |"


def together(ending: str, processes: int, rows: int, turns: int, folder: Path, draw: random.Random) -> str:
    tables = [ranking(rows - 10_000 * n, 0.5**n) for n in range(processes)]
    wanted = [np.sort(table.margin)[::-1] for table in tables]
    home = folder / f"together_{processes}_{ending}"
    home.mkdir()
    path, outcomes = home / f"file{ending}", {"whole": 0, "broken or mixed": 0, "failed": 0, "litter": 0}
    for _ in range(turns):
        path.unlink(missing_ok=True)
        waits = [draw.uniform(0.0, 0.2) for _ in tables]
        jobs = [
            forked(lambda table=table, wait=wait: (time.sleep(wait), write_table(table, path))[1])
            for table, wait in zip(tables, waits, strict=True)
        ]
        outcomes["failed"] += sum(os.waitpid(job, 0)[1] != 0 for job in jobs)
        try:
            found = margins_of(path)
            outcomes["whole" if any(np.array_equal(found, w) for w in wanted) else "broken or mixed"] += 1
        except Exception:
            outcomes["broken or mixed"] += 1
        outcomes["litter"] += len(list(home.iterdir())) > 1
    return f"| {ending} | {processes} | {turns} | {' | '.join(map(str, outcomes.values()))} |"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=30)
    options.add_argument("--turns", type=int, default=12)
    options.add_argument("--rows", type=int, default=150_000)
    options.add_argument("--output", type=Path)
    given = options.parse_args()
    draw = random.Random(0)
    lines = [
        "| writer | it takes, s | kills | old file | new file | broken | gone | litter after a kill | after a run |"
    ]
    lines.append("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as name:
        for writer in writers(10):
            lines.append(killed(writer, given.rows, given.count, Path(name), draw))
            print(lines[-1], flush=True)
        lines += [
            "",
            "| file | processes | turns | whole | broken or mixed | processes that failed | turns with litter |",
        ]
        lines.append("|---|---:|---:|---:|---:|---:|---:|")
        for processes in (2, 4):
            for ending in (".parquet", ".csv", ".npz"):
                lines.append(together(ending, processes, given.rows, given.turns, Path(name), draw))
                print(lines[-1], flush=True)
    if given.output:
        given.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
