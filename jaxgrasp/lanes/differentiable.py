"""Kernels over the lanes of a batch, with derivatives that are kernels, too.

The values come from stages that JAX does not look into (the solver's loop runs in them). Derivatives come from
functions of the same data that are as cheap as they can be, see `derivatives`; here they are applied to lanes.
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
Raw = dict[str, jax.Array]


@dataclass(frozen=True)
class Lanes:
    """How the arguments of a kernel lie: leaves (lanes, ...), or without the leading axis where shared.

    admit: makes of them, lanes last, what the kernels take.
    shared: by name of the argument.
    rows: how many rows a lane has, which sets the size of a tile.
    compact: whether a tile can be one function, see `map_lanes`.
    tile: lanes of a tile that cannot.
    known_as: tells `admit` from all others that take arguments of the same names and shapes.
    """

    admit: Callable[[Raw], Any]
    shared: dict[str, bool]
    rows: int
    compact: bool
    tile: int
    known_as: str


class Kernel(Protocol):
    """What is computed for every lane, and how it varies with the arguments."""

    @property
    def rows(self) -> int:
        """How many rows a contact has but for the bound on its force, which sets the size of a tile."""
        ...

    @property
    def tile(self) -> int | None:
        """None where it is free of library calls and large reductions, else how many lanes to work on.

        See `map_lanes`.
        """
        ...

    @property
    def stages(self) -> tuple[Callable[..., Tree], ...]:
        """See `map_lanes`; the first takes (admitted arguments, held)."""
        ...

    def tangents(self, along: "Along", out: Tree, /) -> Tree:
        """The derivative of the results along a change of the arguments; None where it is zero."""
        ...


@dataclass(frozen=True)
class OfPyramids:
    """A kernel with the rows of friction pyramids."""

    cone_edges: int
    tile = None

    @property
    def rows(self) -> int:
        """See `Kernel`; for fewer than eight edges, tiles are large enough."""
        return max(8, self.cone_edges)


class Plain(ABC):
    """A kernel of one stage that is its own derivative's function."""

    tile = None

    @property
    def stages(self) -> tuple[Callable[..., Tree], ...]:
        """See `Kernel`."""
        return (lambda admitted, _: self.evaluate(admitted),)

    @abstractmethod
    def evaluate(self, admitted: Any, /) -> Tree:
        """The results, lanes last."""

    def tangents(self, along: "Along", out: Tree) -> Tree:
        """See `Kernel`."""
        return along.function(self.evaluate, out)


@dataclass(frozen=True)
class Along:
    """A change of the arguments of all lanes; `moved` has those that change at all."""

    lanes: Lanes
    arguments: Raw
    moved: Raw

    def function(self, function: Callable[[Any], Tree], like: Tree) -> Tree:
        """The derivative of `function(admitted arguments)`, lanes last, as JAX finds it."""

        def kernel(arguments: Raw, moved: Raw) -> Tree:
            at, start = self._admitted(arguments, moved)
            return jax.jvp(lambda some: function(at(some)), (start,), (moved,))[1]

        return linear_lanes(kernel, self.arguments, self.moved, self.lanes.shared, like)

    def adjoint(self, adjoint: Callable[[Any, Tree, Tree, frozenset], Any], held: Tree, like: Tree) -> Tree:
        """The derivative whose transpose is given.

        Args:
            adjoint: called with the admitted arguments, `held`, cotangents (like `like`, None where zero) and the names
                of the arguments that change; returns the cotangents of the admitted arguments.
            held: what it is given beside the arguments, leaves (lanes, ...).
            like: arrays like the result.
        """
        names = frozenset(self.moved)

        def back(data: tuple[Raw, Tree], cotangents: Tree) -> Raw:
            arguments, held = data
            lanes = jax.tree.leaves(cotangents)[0].shape[-1]
            like = {name: jnp.broadcast_to(arguments[name], (*arguments[name].shape[:-1], lanes)) for name in names}
            at, start = self._admitted(arguments, like)
            admitted, pull = jax.vjp(at, start)
            return pull(adjoint(admitted, held, cotangents, names))[0]

        # With respect to the set itself there are reductions, and roots of matrices are library calls; what comes with
        # actuators is JAX's own transpose.
        compact = self.lanes.compact and "jacobian" not in self.arguments
        compact &= not any(name.startswith("term") for name in names)
        shared = (self.lanes.shared, jax.tree.map(lambda _: False, held))
        rows = self.lanes.rows if compact else 0
        return transposed_lanes(back, (self.arguments, held), self.moved, shared, like, rows)

    def value(self, kernel: Kernel, held: Tree) -> Tree:
        """Another kernel over the same arguments."""
        return differentiable(kernel, self.lanes, self.arguments, held)

    def _admitted(self, arguments: Raw, moved: Raw) -> tuple[Callable[[Raw], Any], Raw]:
        """The admitted arguments as a function of those that change, and these."""
        start = {name: jnp.broadcast_to(arguments[name], moved[name].shape) for name in moved}
        return lambda some: self.lanes.admit({**arguments, **some}), start


def differentiable(kernel: Kernel, lanes: Lanes, arguments: Raw, held: Tree = ()) -> Tree:
    """Run a kernel over lanes; its derivatives with respect to the arguments, of any order, are its `tangents`.

    Args:
        kernel: what to run.
        lanes: how the arguments lie.
        arguments: by name.
        held: what else the kernel is given, leaves (lanes, ...); constants to the derivative.
    """

    @jax.custom_jvp
    def value(arguments: Raw, held: Tree) -> Tree:
        def enter(given: tuple[Raw, Tree]) -> Tree:
            return kernel.stages[0](lanes.admit(given[0]), given[1])

        shared = (lanes.shared, jax.tree.map(lambda _: False, held))
        stages = (enter, *kernel.stages[1:])
        # Kernels have no state but their fields, which are numbers and names.
        known_as = f"{type(kernel).__module__}.{type(kernel).__qualname__} {vars(kernel)} {lanes.known_as}"
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
        moved = {}
        for name, dot in dots[0].items():
            if type(dot) is not SymbolicZero:
                moved[name] = jnp.broadcast_to(dot, (count, *dot.shape)) if lanes.shared[name] else dot
        if not moved:
            return out, jax.tree.map(partial(zero_from_primal, symbolic_zeros=True), out)
        change = kernel.tangents(Along(lanes, arguments, moved), out)
        still = lambda x, dot: zero_from_primal(x, symbolic_zeros=True) if dot is None else dot
        return out, jax.tree.map(still, out, change, is_leaf=lambda x: x is None)

    return value(arguments, held)
