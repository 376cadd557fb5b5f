"""Functions over the lanes of a batch, with derivatives that are such functions, too.

JAX does not look into the stages that compute the values: the solver's loop runs in them. So a `BatchedFunction` states
its derivative itself, as a function of the same arguments; this module runs that function over the lanes.

The arguments are a pytree of the caller's. Which leaves all lanes share, and which leaves change, is told
by parallel pytrees: with the same structure, and a bool or a change in place of each array.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from jaxgrasp.compiling import own_settings
from jaxgrasp.lanes.linear import linear_lanes, transposed_lanes
from jaxgrasp.lanes.tiles import map_lanes

Tree = Any


@dataclass(frozen=True)
class Lanes:
    """Layout of a batched function's arguments: leaves (lanes, ...), or without the leading axis where shared."""

    admit: Callable[[Tree], Any]
    """Turns the arguments, lanes last, into what the stages take: a function of a module, so that its name tells which
    one it is."""
    shared: Tree
    """A tree parallel to the arguments with a bool for each leaf: all lanes share it."""
    rows: int
    """The number of rows of a lane, which sets the size of a tile."""
    compact: bool
    """True if a tile can be one function, see `map_lanes`."""
    tile: int
    """The number of lanes of a tile that cannot be one function."""


class BatchedFunction(Protocol):
    """A function that is computed for every lane, and how its results vary with the arguments."""

    @property
    def rows(self) -> int:
        """The number of rows of a contact without the bound on its force, which sets the size of a tile."""
        ...

    @property
    def tile(self) -> int | None:
        """The number of lanes of a tile; None for a function without library calls and large reductions."""
        ...

    @property
    def stages(self) -> tuple[Callable[..., Tree], ...]:
        """The parts that run one after another, see `map_lanes`; the first takes (admitted arguments, held)."""
        ...

    def tangents(self, along: "Along", out: Tree, /) -> Tree:
        """The derivative of the results along a change of the arguments; None where it is zero."""
        ...


@dataclass(frozen=True)
class OfPyramids:
    """A batched function with the rows of friction pyramids."""

    cone_edges: int
    tile = None

    @property
    def rows(self) -> int:
        """n_e, the number of rows of a contact; for fewer than eight, tiles are large enough."""
        return max(8, self.cone_edges)


class Plain(ABC):
    """A batched function of one stage, which JAX differentiates."""

    tile = None

    @property
    def stages(self) -> tuple[Callable[..., Tree], ...]:
        """`evaluate` alone."""
        return (lambda admitted, _: self.evaluate(admitted),)

    @abstractmethod
    def evaluate(self, admitted: Any, /) -> Tree:
        """The results, lanes last."""

    def tangents(self, along: "Along", out: Tree) -> Tree:
        """The derivative of `evaluate`."""
        return along.function(self.evaluate, out)


@dataclass(frozen=True)
class Along:
    """A change of the arguments of all lanes."""

    lanes: Lanes
    """How the arguments lie."""
    arguments: Tree
    """The arguments: leaves (lanes, ...), or without the leading axis where shared."""
    changes: Tree
    """The changes, parallel to the arguments: leaves (lanes, ...), None where a leaf does not change at all."""

    def function(self, function: Callable[[Any], Tree], like: Tree) -> Tree:
        """The derivative of `function(admitted arguments)`, lanes last, as JAX finds it."""

        def kernel(arguments: Tree, changes: Tree) -> Tree:
            at, start = self._admit_changed(arguments, changes)
            return jax.jvp(lambda varied: function(at(varied)), (start,), (changes,))[1]

        return linear_lanes(kernel, self.arguments, self.changes, self.lanes.shared, like)

    def adjoint(self, adjoint: Callable[[Any, Tree, Tree], Any], held: Tree, like: Tree, compact: bool = False) -> Tree:
        """The derivative whose transpose is given.

        Args:
            adjoint: called with the admitted arguments, `held` and cotangents (like `like`, None where zero); returns
                the cotangents of the admitted arguments.
            held: what the adjoint is given beside the arguments, leaves (lanes, ...).
            like: arrays like the result.
            compact: whether the adjoint, too, is free of library calls and large reductions, see `map_lanes`.
        """

        def back(data: tuple[Tree, Tree], cotangents: Tree) -> Tree:
            arguments, held = data
            lanes = jax.tree.leaves(cotangents)[0].shape[-1]
            spread = lambda _, x: jnp.broadcast_to(x, (*x.shape[:-1], lanes))
            at, start = self._admit_changed(arguments, _where_changed(spread, self.changes, arguments))
            admitted, pull = jax.vjp(at, start)
            return pull(adjoint(admitted, held, cotangents))[0]

        shared = (self.lanes.shared, jax.tree.map(lambda _: False, held))
        rows = self.lanes.rows if self.lanes.compact and compact else 0
        return transposed_lanes(back, (self.arguments, held), self.changes, shared, like, rows)

    def value(self, function: BatchedFunction, held: Tree) -> Tree:
        """The value of another batched function of the same arguments."""
        return differentiable(function, self.lanes, self.arguments, held)

    def _admit_changed(self, arguments: Tree, changes: Tree) -> tuple[Callable[[Tree], Any], Tree]:
        """The admitted arguments as a function of those that change, and these."""
        start = _where_changed(lambda change, x: jnp.broadcast_to(x, change.shape), changes, arguments)
        instead = lambda new, x: x if new is None else new
        return lambda varied: self.lanes.admit(jax.tree.map(instead, varied, arguments, is_leaf=_is_none)), start


def _where_changed(function: Callable[[Any, Any], Any], changes: Tree, arguments: Tree) -> Tree:
    """`function` of each change and its argument, None where there is no change."""
    apply = lambda change, x: None if change is None else function(change, x)
    return jax.tree.map(apply, changes, arguments, is_leaf=_is_none)


def _is_none(x: Any) -> bool:
    return x is None


def differentiable(function: BatchedFunction, lanes: Lanes, arguments: Tree, held: Tree = ()) -> Tree:
    """Run a batched function over lanes; its derivatives with respect to the arguments, of any order, are `tangents`.

    Args:
        function: what to run.
        lanes: how the arguments lie.
        arguments: a pytree of arrays, leaves (lanes, ...), or without the leading axis where shared.
        held: what else the function is given, leaves (lanes, ...); constants to the derivative.
    """

    @jax.custom_jvp
    def value(arguments: Tree, held: Tree) -> Tree:
        def enter(inputs: tuple[Tree, Tree]) -> Tree:
            return function.stages[0](lanes.admit(inputs[0]), inputs[1])

        shared = (lanes.shared, jax.tree.map(lambda _: False, held))
        stages = (enter, *function.stages[1:])
        # Batched functions have no state but their fields, which are numbers, names and types.
        name = lambda x: f"{x.__module__}.{x.__qualname__}"
        known_as = f"{name(type(function))} {vars(function)} {name(lanes.admit)}"
        return map_lanes(
            stages,
            (arguments, held),
            shared,
            lanes.rows,
            compact=lanes.compact,
            tile=lanes.tile,
            known_as=known_as,
        )

    @partial(value.defjvp, symbolic_zeros=True)
    @own_settings()
    def derivative(primals: tuple, dots: tuple) -> tuple[Tree, Tree]:
        arguments, held = primals
        out = value(arguments, held)
        count = jax.tree.leaves(out)[0].shape[0]

        def change_of(dot: Any, shared: bool) -> jax.Array | None:
            if type(dot) is SymbolicZero:
                return None
            return jnp.broadcast_to(dot, (count, *dot.shape)) if shared else dot

        changes = jax.tree.map(change_of, dots[0], lanes.shared)
        if not jax.tree.leaves(changes):
            return out, jax.tree.map(partial(zero_from_primal, symbolic_zeros=True), out)
        tangents = function.tangents(Along(lanes, arguments, changes), out)
        still = lambda x, dot: zero_from_primal(x, symbolic_zeros=True) if dot is None else dot
        return out, jax.tree.map(still, out, tangents, is_leaf=_is_none)

    return value(arguments, held)
