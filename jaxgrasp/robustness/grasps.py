"""From the public, batch-first arguments to the lanes that the kernels work on, with every check of the data."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp import linalg
from jaxgrasp.arrays import as_float, fold
from jaxgrasp.compiling import compiled
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance, inverse_root
from jaxgrasp.contact.contacts import Contacts, rotations
from jaxgrasp.contact.grasp_map import grasp_columns
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.terms import Term
from jaxgrasp.kernels import usable
from jaxgrasp.lanes.differentiable import Kernel, Lanes, differentiable
from jaxgrasp.lanes.direct import cut
from jaxgrasp.lanes.tiles import LOOSE_TILE, TILE
from jaxgrasp.robustness.actuators import Actuated, limited, stacked_rows
from jaxgrasp.robustness.auditing import audited
from jaxgrasp.robustness.interface.arguments import Arguments, laid_out
from jaxgrasp.robustness.interface.sizes import with_a_known_size


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Grasps:
    """Grasps in lanes (the trailing axis), made safe: what is absent or not admissible is replaced by harmless data.

    Moments are divided by `length`, so that all wrench components are forces.
    """

    valid: jax.Array
    """(*lanes), bool: all data of the lane are admissible; the others have no contact present."""
    present: jax.Array
    """(n, *lanes), 1 where a contact is there, else 0."""
    friction: jax.Array
    """(n, *lanes)."""
    max_force: jax.Array
    """(n, *lanes), N."""
    length: jax.Array
    """(*lanes), root-mean-square distance of the contacts from the centre of mass, m; 1 where that is zero."""
    units: jax.Array
    """(6, *lanes), what turns wrenches in N and N m to newtons: 1 and 1 / length."""
    columns: jax.Array
    """(6, 3, n, *lanes), the blocks of G; zero where absent."""
    lined: jax.Array
    """bool (*lanes), all contacts are on one line, exactly: two of them always are. G has rank 5 at most."""
    wrench: jax.Array
    """(6, *lanes), b, N."""
    reserve: jax.Array
    """(*lanes), d, N."""
    terms: tuple[Term, ...]
    """The disturbance set, moments in N m; leaves may have lanes of size 1."""
    extents: tuple[jax.Array, ...]
    """(6, *lanes) each, the largest |w_i| of every term."""
    half: jax.Array | None
    """M with M M' = Q^-1, see `inverse_root`; None for Q = I."""
    vertex_halves: jax.Array | None
    """The same for each vertex of the disturbance set, along the leading axis."""
    weights: jax.Array | None
    """(n, 3, 3, *lanes), blocks of Q_0; None for I."""
    weight_roots: jax.Array | None
    """(3, 3, n, *lanes), R with R'R = Q_0."""
    margin: jax.Array | None
    """(*lanes), the margin that is asked for."""
    smoothing: jax.Array | None
    """(*lanes), kappa of the central point that is asked for."""
    cutoff: jax.Array | None
    """(*lanes), what the margin must reach to be of interest."""
    actuated: Actuated | None
    """What the hand's actuators can do; None where the fingers can push at will."""

    @property
    def asked(self) -> jax.Array:
        """`margin`, of grasps for which one is asked for."""
        assert self.margin is not None
        return self.margin

    @property
    def rows(self) -> jax.Array:
        """(6 + r, 3, n, *lanes), the blocks of G, and of N'J' where actuators do not reach every joint direction."""
        return stacked_rows(self.columns, self.actuated)


def over_grasps(
    kernel: Kernel,
    contacts: Contacts,
    disturbances: DisturbanceSet,
    required_wrench: Any = None,
    compliance: Any = None,
    cone_margin: Any = 0.0,
    effort_weights: Any = None,
    margin: Any = None,
    smoothing: Any = None,
    cutoff: Any = None,
    actuation: Any = None,
) -> Any:
    """Check shapes, run a kernel over all grasps of a batch, audit its results and give them the batch's shape.

    The kernel takes `Grasps`. The contacts' dtype is the precision of everything. Compiled once for a kernel (they
    compare by value) and the shapes, which `sizes` keeps few.

    Raises:
        ValueError: shapes or kinds of argument that do not fit.
    """
    if not isinstance(contacts, Contacts):
        raise ValueError(f"contacts: got {type(contacts).__name__}, wanted jaxgrasp.Contacts")
    contacts.check_precision()
    if not isinstance(disturbances, DisturbanceSet):
        raise ValueError(f"disturbances: got {type(disturbances).__name__}, wanted jaxgrasp.DisturbanceSet")
    given = {
        "required_wrench": required_wrench,
        "compliance": compliance,
        "cone_margin": cone_margin,
        "effort_weights": effort_weights,
        "margin": margin,
        "smoothing": smoothing,
        "cutoff": cutoff,
    }
    for name, value in given.items():
        if value is not None and not isinstance(value, Compliance):
            given[name] = as_float(name, value, ())
    if actuation is not None and not isinstance(actuation, Actuation):
        raise ValueError(f"actuation: got {type(actuation).__name__}, wanted jaxgrasp.Actuation")
    if actuation is not None and not actuation.transmission.shape[-1]:
        raise ValueError("actuation: got no actuators, wanted at least one; leave it out and fingers push at will")
    given["actuation"] = actuation
    fill = with_a_known_size(kernel, contacts, disturbances, given)
    if fill is None:
        return audited(kernel, _run(kernel, contacts, disturbances, given), contacts, disturbances, given)
    count = fill.count
    out = _run(kernel, fill.contacts, disturbances, fill.given)
    return cut(audited(kernel, out, fill.contacts, disturbances, fill.given, count), count)


@functools.partial(compiled, static_argnums=(0,), pace=lambda *_: "brief" if usable() else "fast")
def _run(kernel: Kernel, contacts: Contacts, disturbances: DisturbanceSet, given: dict) -> Any:
    """Run the kernel over the lanes."""
    arguments = laid_out(contacts, disturbances, given)
    n = contacts.n_c
    leaves, batch = arguments.leaves, arguments.batch

    def admit(raw: dict[str, jax.Array]) -> Grasps:
        return admitted(arguments, raw)

    # Library calls, as for the roots of Q, cannot be part of a compact tile.
    compact = kernel.tile is None and not {"compliance", "per_vertex", "weights"} & set(leaves)
    rows = n * (kernel.rows + 1)
    if given["actuation"] is not None:
        # The equality rows are what is largest; up to twice as many values were seen to compile.
        joints, actuators = given["actuation"].transmission.shape[-2:]
        rows = max(rows, math.ceil((6 + joints) * (3 * n + actuators) * TILE / 12_000))
    lanes = Lanes(admit, arguments.shared, rows, compact, kernel.tile or LOOSE_TILE, str(arguments.structure))
    out = differentiable(kernel, lanes, leaves)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), out)


_TRANSMISSION = {"transmission", "inverse", "unreached"}


def grasps_of(arguments: Arguments) -> Grasps:
    """The grasps of public arguments, outside of any kernel."""
    leaves = arguments.leaves.items()
    return admitted(arguments, {k: x[..., None] if arguments.shared[k] else jnp.moveaxis(x, 0, -1) for k, x in leaves})


def admitted(arguments: Arguments, raw: dict[str, jax.Array]) -> Grasps:
    """Check the data of every lane, lanes trailing, and replace what cannot be used."""
    terms = arguments.terms(raw)
    extents = tuple(raw[f"extent {i}"] for i in range(len(terms)))
    positions, frames, active = raw["positions"], raw["frames"], raw["active"]
    n, dtype = positions.shape[0], positions.dtype
    sound = jnp.isfinite(positions).all(1) & rotations(frames)
    sound &= (raw["friction"] >= 0) & jnp.isfinite(raw["friction"])
    sound &= (raw["max_force"] > 0) & jnp.isfinite(raw["max_force"])
    half, usable = inverse_root(_masked(raw.get("compliance"), active), n)
    valid = (sound | ~active).all(0) & usable
    # One Q a direction: the directions trail the lanes while the roots are taken.
    vertex_halves = None
    if "per_vertex" in raw:
        each = jnp.moveaxis(raw["per_vertex"], 0, -1)
        vertex_halves, usable = inverse_root(_masked(each, active[..., None]), n)
        assert vertex_halves is not None
        vertex_halves, valid = jnp.moveaxis(vertex_halves, -1, 0), valid & usable.all(-1)
    weights, weight_roots = _masked(raw.get("weights"), active), None
    if weights is not None:
        valid &= inverse_root(weights, n)[1]
        sane = jnp.where(valid, weights, jnp.eye(3, dtype=dtype)[..., None])
        weight_roots = jnp.moveaxis(linalg.cholesky(jnp.moveaxis(sane, (1, 2), (-1, -2))), (-1, -2), (0, 1))
    valid &= jnp.isfinite(raw["wrench"]).all(0) & (raw["reserve"] >= 0) & jnp.isfinite(raw["reserve"])
    for extent in extents:
        valid &= (jnp.isfinite(extent) & (extent >= 0)).all(0)
    valid &= _sound_actuation(raw, active)
    margin = raw.get("margin")
    if margin is not None:
        valid &= (margin >= 0) & jnp.isfinite(margin)
        margin = jnp.where(valid, margin, 0)
    smoothing = raw.get("smoothing")
    if smoothing is not None:
        valid &= (smoothing > 0) & jnp.isfinite(smoothing)
        smoothing = jnp.where(valid, smoothing, 1)

    # A choice of units: nothing that is reported in newtons and metres depends on it.
    length, usable = _length(positions, active & valid, raw["wrench"], extents)
    valid &= usable
    length = jnp.where(valid, length, 1)
    there = active & valid
    positions = jnp.where(there, jnp.moveaxis(positions, 1, 0), 0)
    frames = jnp.where(there, jnp.moveaxis(frames, (1, 2), (0, 1)), 0)
    units = jnp.stack([jnp.ones_like(length)] * 3 + [1 / length] * 3)
    wrench = jnp.where(valid, raw["wrench"], 0)
    friction, max_force = jnp.where(there, raw["friction"], 1), jnp.where(there, raw["max_force"], 1)
    return Grasps(
        valid=valid,
        present=there.astype(dtype),
        friction=friction,
        max_force=max_force,
        length=length,
        units=units,
        columns=grasp_columns(positions / length, frames),
        lined=_lined(positions, there),
        wrench=wrench * units,
        reserve=jnp.where(valid, raw["reserve"], 0),
        terms=terms,
        extents=extents,
        half=half,
        vertex_halves=vertex_halves,
        weights=weights,
        weight_roots=weight_roots,
        margin=margin,
        smoothing=smoothing,
        cutoff=raw.get("cutoff"),
        actuated=_actuated(raw, there, valid, length, friction, max_force) if "jacobian" in raw else None,
    )


def _lined(positions: jax.Array, there: jax.Array) -> jax.Array:
    """Whether the points (3, n, *lanes) that are there lie on one line.

    Products are compared, not subtracted: a difference of products may be rounded once or twice, as compilers like.
    """
    first, far = positions[:, 0], jnp.zeros_like(positions[:, 0])
    for i in range(1, positions.shape[1]):
        first = jnp.where(there[:i].any(0), first, positions[:, i])
    apart = jnp.where(there, positions - first[:, None], 0)
    for i in range(positions.shape[1]):
        further = fold(jnp.maximum, jnp.abs(apart[:, i])) > fold(jnp.maximum, jnp.abs(far))
        far = jnp.where(further, apart[:, i], far)
    along = [apart[a] * far[(a + 1) % 3] == apart[(a + 1) % 3] * far[a] for a in range(3)]
    return fold(jnp.logical_and, [row.all(0) for row in along])


def _length(
    positions: jax.Array, there: jax.Array, wrench: jax.Array, extents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    """The root-mean-square distance of contacts (n, 3, *lanes), 1 where zero, and whether moments can be told in it."""
    own = lax.stop_gradient(jnp.where(there, jnp.moveaxis(positions, 1, 0), 0))
    # In units of the largest, whose square may be more, or less, than there are numbers for.
    largest = fold(jnp.maximum, fold(jnp.maximum, jnp.abs(own)))
    largest = jnp.where(largest > 0, largest, 1)
    count = jnp.maximum(fold(jnp.add, there.astype(own.dtype)), 1)
    mean = fold(jnp.add, fold(jnp.add, (own / largest) ** 2)) / count
    length = largest * jnp.sqrt(jnp.where(mean > 0, mean, 1))
    usable = jnp.isfinite(length) & jnp.isfinite(1 / length)
    for moment in (wrench, *extents):
        usable &= jnp.isfinite(lax.stop_gradient(moment[3:]) / length).all(0)
    return length, usable


def _sound_actuation(raw: dict[str, jax.Array], active: jax.Array) -> jax.Array:
    """Whether everything that is used is finite, and no limits cross, (*lanes)."""
    if "jacobian" not in raw:
        return jnp.array(True)
    # A sum is finite where all of its terms are. Spelt out: large reductions are library calls.
    total = lambda x: fold(jnp.add, fold(jnp.add, jnp.abs(x)))
    sound = (jnp.isfinite(total(jnp.moveaxis(raw["jacobian"], 0, 2))) | ~active).all(0)
    for name in sorted(_TRANSMISSION & set(raw)):
        sound &= jnp.isfinite(total(raw[name]))
    return sound & ((raw["lower"] <= raw["upper"]) & (raw["lower"] < jnp.inf) & (raw["upper"] > -jnp.inf)).all(0)


def _actuated(
    raw: dict[str, jax.Array],
    there: jax.Array,
    valid: jax.Array,
    length: jax.Array,
    friction: jax.Array,
    max_force: jax.Array,
) -> Actuated:
    jacobian = jnp.where(there[:, None, None], raw["jacobian"], 0)
    sane = {name: jnp.where(valid, raw[name], 0) for name in sorted(_TRANSMISSION & set(raw))}
    actuated = Actuated(
        joints=jnp.moveaxis(jacobian, (2, 1, 0), (0, 1, 2)) / length,
        transmission=sane["transmission"] / length,
        inverse=sane["inverse"] * length,
        unreached=sane.get("unreached"),
        lower=jnp.where(valid, raw["lower"], -1),
        upper=jnp.where(valid, raw["upper"], 1),
    )
    return limited(actuated, friction, jnp.where(there, max_force, 0))


def _masked(matrices: jax.Array | None, active: jax.Array) -> jax.Array | None:
    """Blocks or full matrices of contacts with the absent ones' rows and columns replaced by the identity's."""
    if matrices is None:
        return None
    full = matrices.shape[:2] == (3 * active.shape[0],) * 2
    eye = jnp.eye(matrices.shape[1], dtype=matrices.dtype).reshape(
        (() if full else (1,)) + matrices.shape[1:2] * 2 + (1,) * (active.ndim - 1)
    )
    if not full:
        return jnp.where(active[:, None, None], matrices, eye)
    there = jnp.repeat(active, 3, 0)
    return jnp.where(there[:, None] & there[None], matrices, eye)
