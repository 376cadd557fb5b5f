"""Solves for many candidates in tiles of bounded memory, each spread over the devices of this process."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from jaxgrasp.candidates import Candidates
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Actuation, Contacts, required_wrench
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.lanes.direct import power_of_two
from jaxgrasp.robustness import largest_disturbance, least_effort

# Candidates a tile: enough to keep each core busy for tens of milliseconds, few enough that a tile's arrays stay below
# some tens of megabytes. Accelerators want more at once.
TILE = {"cpu": 8192}
ACCELERATOR_TILE = 131_072
# So few candidates are solved before fast code would be compiled.
_FEW = 256

Columns = dict[str, np.ndarray]


def columns_of(candidates: Candidates) -> Columns:
    """Gathers what the programs need of each candidate.

    A negative mass becomes NaN, so that it is this candidate's own INVALID_INPUT.
    """
    columns = {
        "positions": candidates.positions,
        "friction": candidates.friction,
        "max_force": candidates.max_force,
        "active": candidates.active,
        "mass": np.where(candidates.mass >= 0.0, candidates.mass, np.nan),
    }
    if candidates.frames is not None:
        columns["frames"] = candidates.frames
    if candidates.torsional_friction is not None:
        columns["torsional_friction"] = candidates.torsional_friction
    if candidates.outward_normals is not None:
        columns["outward_normals"] = candidates.outward_normals
    return columns | candidates.hand


def contacts_of(columns: Columns) -> Contacts:
    """The contacts of candidates by their columns."""
    make = Contacts.from_frames if "frames" in columns else Contacts.from_normals
    return make(
        columns["positions"],
        columns["frames"] if "frames" in columns else columns["outward_normals"],
        friction=columns["friction"],
        max_force=columns["max_force"],
        active=columns["active"],
        torsional_friction=columns.get("torsional_friction"),
    )


def load_of(columns: Any, gravity: Any) -> Any:
    """The wrench that candidates have to supply: under gravity along the object's -z, m/s^2, or that of their columns.

    Args:
        columns: What `columns_of` gathers, and maybe required_wrench.
        gravity: None or 0.0 for none.
    """
    if gravity is None or (isinstance(gravity, float) and gravity == 0.0):
        return columns.get("required_wrench")
    return required_wrench(columns["mass"], gravity=jnp.array([0.0, 0.0, -1.0]) * gravity)


def task_of(columns: Any, gravity: Any, cone_edges: int) -> dict[str, Any]:
    """The arguments of (21) and (22) beside contacts and disturbances.

    Args:
        columns: As for `load_of`.
        gravity: Likewise.
        cone_edges: Edges of the friction pyramid.
    """
    actuation = None
    if "jacobian" in columns:
        actuation = Actuation(**{f.name: columns.get(f.name) for f in dataclasses.fields(Actuation)})
    return {"required_wrench": load_of(columns, gravity), "cone_edges": cone_edges, "actuation": actuation}


def solve_in_tiles(
    solver: Callable[..., Any],
    columns: Columns,
    disturbances: DisturbanceSet,
    *,
    gravity: float,
    cone_edges: int,
    tile: int | None,
    stream: bool = False,
) -> Iterator[tuple[slice, Any]]:
    """Runs a solver over all candidates, one tile after the other with one compilation.

    Args:
        solver: `margins` or `tightening`.
        columns: What it needs of each candidate, with a leading axis of N.
        disturbances: The set, the same for all.
        gravity: Along the object's -z, m/s^2; zero means that no weight but that of `required_wrench` need be borne.
        cone_edges: Edges of the friction pyramid.
        tile: Candidates at a time, at most; None chooses by platform.
        stream: Whether other batches follow, of other lengths: then tiles are of few sizes, so that few programs serve
            all of them.

    Yields:
        The rows of each tile and the solver's answer for them, in NumPy.
    """
    mesh = Mesh(np.array(jax.local_devices()), ("candidates",))
    count = len(columns["positions"])
    tile = tile or TILE.get(jax.default_backend(), ACCELERATOR_TILE)
    # Tiles of equal size waste less than a last one that is mostly padding.
    tiles = max(1, math.ceil(count / tile))
    size = math.ceil(count / tiles / mesh.size) * mesh.size
    if stream:
        size = math.ceil(min(tile, power_of_two(count, _FEW)) / mesh.size) * mesh.size
    for start in range(0, count, max(size, 1)):
        stop = min(start + size, count)
        padded = {name: _padded(column[start:stop], size) for name, column in columns.items()}
        answer = _solve_tile(padded, disturbances, gravity, solver, cone_edges, gravity != 0.0, mesh)
        yield slice(start, stop), jax.tree.map(lambda leaf, n=stop - start: np.asarray(leaf)[:n], answer)


def margins(contacts: Contacts, disturbances: DisturbanceSet, task: dict[str, Any], columns: Any) -> Any:
    """Solves (21): margin, upper bound, status; below the column `cutoff`, where there is one, not to the end."""
    solution = largest_disturbance(contacts, disturbances, cutoff=columns.get("cutoff"), **task)
    return solution.margin, solution.upper_bound, solution.status


def tightening(contacts: Contacts, disturbances: DisturbanceSet, task: dict[str, Any], columns: Any) -> Any:
    """Solves (22) at the margins of the column `wanted`.

    Returns:
        Forces in contact and in object frames, moments about the normals (without a contact where all are hard),
        effort, status, and the commands of a hand's actuators, of which there may be none.
    """
    solution = least_effort(contacts, disturbances, columns["wanted"], **task)
    controls = jnp.zeros((len(solution.effort), 0), solution.effort.dtype)
    if "controls_per_effort" in columns:
        assert solution.actuator_efforts is not None
        own = solution.actuator_efforts[:, : columns["idle_controls"].shape[-1]]
        controls = columns["idle_controls"] + columns["controls_per_effort"] * own
    moments = controls[:, :0] if solution.moments is None else solution.moments
    turned = solution.forces_in_object_frame(contacts)
    return solution.forces, turned, moments, solution.effort, solution.status, controls


def _few(columns: Columns) -> bool:
    return jax.default_backend() == "cpu" and len(columns["positions"]) <= _FEW


@functools.partial(compiled, static_argnums=(3, 4, 5, 6), pace=lambda columns, *_: "soon" if _few(columns) else "fast")
def _solve_tile(
    columns: Any, disturbances: DisturbanceSet, gravity: Any, solver: Any, cone_edges: int, loaded: bool, mesh: Mesh
) -> Any:
    def on_one_device(columns: Any, disturbances: DisturbanceSet, gravity: Any) -> Any:
        task = task_of(columns, gravity if loaded else None, cone_edges)
        return solver(contacts_of(columns), disturbances, task, columns)

    spread = jax.shard_map(on_one_device, mesh=mesh, in_specs=(P("candidates"), P(), P()), out_specs=P("candidates"))
    return spread(columns, disturbances, gravity)


def _padded(column: np.ndarray, size: int) -> np.ndarray:
    return np.pad(column, [(0, size - len(column))] + [(0, 0)] * (column.ndim - 1), mode="edge")
