"""The quantities of grasps that are not known, and how they are distributed.

A draw is a deviation from what a grasp says. The draws are the same for all grasps (common random numbers), so that
what tells grasps apart is not their luck.
"""

import math
from collections.abc import Sequence
from dataclasses import field, fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float
from jaxgrasp.records import record

# A correlation matrix is symmetric with ones on its diagonal, and has no eigenvalue below zero, but for rounding.
_ROUNDING = 1e-6

Numbers = ArrayLike | Sequence[Any]
"""A number, an array, or nested lists."""


class Quantity(NamedTuple):
    """The shape of a quantity's deviations."""

    of_contacts: bool
    """Whether every contact has its own."""
    components: tuple[int, ...]
    """The shape for one contact, or for the grasp."""
    most: float = math.inf
    """The largest spread that can be meant."""

    def shape(self, n_c: int) -> tuple[int, ...]:
        """The shape for a grasp of n_c contacts."""
        return ((n_c,) if self.of_contacts else ()) + self.components


QUANTITIES = {
    "friction": Quantity(True, ()),
    "position": Quantity(True, (3,)),
    "normal": Quantity(True, (2,), math.pi),
    "max_force": Quantity(True, ()),
    "mass": Quantity(False, ()),
    "center_of_mass": Quantity(False, (3,)),
    "load": Quantity(False, (6,)),
}
"""All that can be random, by the names in `Uncertainty`."""


@record
class Distribution:
    """Independent or correlated deviations; make one with `normal` or `uniform`.

    Behind each component is a standard normal number that is turned into its deviation. Correlations are those of these
    numbers (a Gaussian copula).
    """

    spread: Float[Array, "..."]
    """The standard deviation of a normal distribution, before truncation, or half the width of a uniform one."""
    mean: Float[Array, "..."]
    """The mean before truncation; the middle of a uniform distribution."""
    bounds: tuple[Float[Array, "..."], Float[Array, "..."]] | None
    """The least and the largest deviation of a truncated normal distribution; None without truncation."""
    between_contacts: Float[Array, ""] | None
    """The correlation between any two contacts, the same for every component; None is 0."""
    root: Float[Array, "all all"] | None
    """L with L L' the correlation matrix of all components of a grasp, contact by contact; None where there is none."""
    uniform: bool = field(default=False, metadata={"static": True})
    """Whether the distribution is uniform."""

    def deviations(self, numbers: jax.Array) -> jax.Array:
        """Turn standard normal numbers (..., *shape) into deviations of this distribution."""
        if self.uniform:
            return self.mean + self.spread * (2 * ndtr(numbers) - 1)
        if self.bounds is None:
            return self.mean + self.spread * numbers
        still = self.spread == 0
        spread = jnp.where(still, 1, self.spread)
        low, high = (ndtr((bound - self.mean) / spread) for bound in self.bounds)
        inside = self.mean + spread * ndtri(low + (high - low) * ndtr(numbers))
        # Bounds far out in a tail leave no probability between them that rounding could tell from zero.
        return jnp.where(still, self.mean, jnp.clip(inside, *self.bounds))


@record
class Samples:
    """Deviations that are given; make one with `samples`."""

    values: Float[Array, "samples ..."]
    """One deviation a sample, or one for each contact or component."""


@record
class Uncertainty:
    """The distributions of what is not known of grasps; make one with `of`.

    | quantity | its deviations | shape |
    |---|---|---|
    | friction | added to Coulomb's coefficient | (n_c,) |
    | position | added to contact points along t1, t2 and n, m | (n_c, 3) |
    | normal | turn contact frames about t1 and t2, rad | (n_c, 2) |
    | max_force | times (1 + deviation): the largest normal force | (n_c,) |
    | mass | times (1 + deviation): the required wrench | () |
    | center_of_mass | moves it in the object frame, m | (3,) |
    | load | added to the required wrench, N and N m | (6,) |

    Friction below 0, masses below 0 and largest forces below a thousandth of what they were are moved back there, and
    `MarginDistribution.clipped` says how often. The required wrench and the disturbances act at the drawn centre of
    mass.
    """

    friction: Distribution | Samples | None = None
    """Coulomb's friction coefficient."""
    position: Distribution | Samples | None = None
    """Contact points."""
    normal: Distribution | Samples | None = None
    """Normals, with the tangents."""
    max_force: Distribution | Samples | None = None
    """The largest normal force, as a share of itself."""
    mass: Distribution | Samples | None = None
    """The mass, as a share of itself."""
    center_of_mass: Distribution | Samples | None = None
    """The centre of mass."""
    load: Distribution | Samples | None = None
    """The required wrench."""

    @classmethod
    def of(cls, **quantities: "Distribution | Samples | Numbers | None") -> "Uncertainty":
        """The distributions by the names of quantities; a number is the standard deviation of a normal distribution.

        Raises:
            ValueError: there is none, a name is unknown, a distribution cannot be one of its quantity, or samples
                differ in number.

        Example:
            >>> jg.Uncertainty.of(friction=0.1, position=0.002, normal=np.radians(10), center_of_mass=0.005)
        """
        found = {}
        for name, given in quantities.items():
            if name not in QUANTITIES:
                raise ValueError(f"uncertainty: got {name!r}, wanted one of {', '.join(QUANTITIES)}")
            if given is not None:
                found[name] = given if isinstance(given, Distribution | Samples) else normal(given)
                _check_quantity(name, found[name])
        if not found:
            raise ValueError(f"uncertainty: got nothing, wanted at least one of {', '.join(QUANTITIES)}")
        uncertainty = cls(**found)
        uncertainty.sample_count()
        return uncertainty

    def given(self) -> dict[str, Distribution | Samples]:
        """The distributions that there are, by the names of their quantities."""
        every = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in every.items() if value is not None}

    def sample_count(self) -> int | None:
        """The number of samples that are given; None where there are none.

        Raises:
            ValueError: samples of different quantities differ in number.
        """
        counts = {name: len(x.values) for name, x in self.given().items() if isinstance(x, Samples)}
        if len(set(counts.values())) > 1:
            told = ", ".join(f"{count} of {name}" for name, count in counts.items())
            raise ValueError(f"uncertainty: got {told}, wanted as many samples of each")
        return next(iter(counts.values()), None)


def normal(
    std: Numbers,
    mean: Numbers = 0.0,
    lower: Numbers | None = None,
    upper: Numbers | None = None,
    correlation: Numbers | None = None,
) -> Distribution:
    """A normal distribution of deviations, truncated where bounds are given.

    Args:
        std: the standard deviation before truncation, in the quantity's unit: a number, or an array that broadcasts to
            the quantity's shape, see `Uncertainty`.
        mean: the mean before truncation.
        lower: the least deviation; None is minus infinity.
        upper: the largest deviation; None is infinity.
        correlation: one number in [0, 1] between any two contacts, or the matrix of all components of a grasp, contact
            by contact. None is independent.

    Raises:
        ValueError: a number is not finite, std is negative, bounds cross, or the correlation is none.
    """
    bounds = None
    if lower is not None or upper is not None:
        low, high = (-math.inf if lower is None else lower), (math.inf if upper is None else upper)
        bounds = as_float("lower", low, ()), as_float("upper", high, ())
        _refuse("lower", lower, not _known(bounds[0] < bounds[1]), "less than upper")
    return _distribution("std", std, mean, bounds, correlation, uniform=False)


def uniform(half_width: Numbers, mean: Numbers = 0.0, correlation: Numbers | None = None) -> Distribution:
    """A uniform distribution of deviations between mean - half_width and mean + half_width.

    Args:
        half_width: in the quantity's unit, broadcasting as the std of `normal`.
        mean: the middle.
        correlation: as for `normal`.

    Raises:
        ValueError: a number is not finite, half_width is negative, or the correlation is none.
    """
    return _distribution("half_width", half_width, mean, None, correlation, uniform=True)


def samples(values: Numbers) -> Samples:
    """Deviations that are given, of any joint distribution: sample k of all quantities belongs together.

    Args:
        values: (samples,), one for all contacts and components, or (samples, *shape), see `Uncertainty`.

    Raises:
        ValueError: there are none, or a number is not finite.
    """
    found = as_float("samples", values, ())
    if found.ndim == 0 or not len(found):
        raise ValueError(f"samples: got shape {found.shape}, wanted (samples, ...) with at least one")
    _refuse("samples", "NaN or infinite entries", not _known(jnp.isfinite(found)), "finite numbers")
    return Samples(values=found)


def _distribution(
    name: str, spread: Numbers, mean: Numbers, bounds: Any, correlation: Numbers | None, *, uniform: bool
) -> Distribution:
    size, middle = as_float(name, spread, ()), as_float("mean", mean, ())
    _refuse(name, spread, not _known(jnp.isfinite(size) & (size >= 0)), "finite numbers >= 0")
    _refuse("mean", mean, not _known(jnp.isfinite(middle)), "finite numbers")
    between, root = None, None
    if correlation is not None:
        matrix = as_float("correlation", correlation, ())
        if matrix.ndim == 0:
            between = matrix
            _refuse("correlation", correlation, not _known((between >= 0) & (between <= 1)), "a number in [0, 1]")
        else:
            root = jnp.asarray(_root_of(matrix))
    return Distribution(spread=size, mean=middle, bounds=bounds, between_contacts=between, root=root, uniform=uniform)


def _root_of(matrix: jax.Array) -> np.ndarray:
    """L with L L' = R.

    Raises:
        ValueError: R is no correlation matrix, or not known while JAX traces.
    """
    wanted = "a correlation matrix: symmetric, with ones on its diagonal and no negative eigenvalue"
    if isinstance(matrix, Tracer):
        raise ValueError(f"correlation: got a traced array, wanted a known {wanted[2:]}")
    found = np.asarray(matrix)
    if found.ndim != 2 or found.shape[0] != found.shape[1]:
        raise ValueError(f"correlation: got shape {found.shape}, wanted {wanted}")
    near = np.isfinite(found).all() and np.abs(found - found.T).max(initial=0) <= _ROUNDING
    if not near or np.abs(np.diag(found) - 1).max(initial=0) > _ROUNDING:
        raise ValueError(f"correlation: got another matrix, wanted {wanted}")
    values, vectors = np.linalg.eigh(found)
    if values.min(initial=0) < -_ROUNDING * len(found):
        raise ValueError(f"correlation: got an eigenvalue of {values.min():.3g}, wanted {wanted}")
    return (vectors * np.sqrt(np.maximum(values, 0))).astype(found.dtype)


def _check_quantity(name: str, given: Distribution | Samples) -> None:
    """Refuse what can be no distribution of this quantity.

    Raises:
        ValueError: it cannot.
    """
    quantity = QUANTITIES[name]
    if isinstance(given, Samples):
        return
    if given.between_contacts is not None and not quantity.of_contacts:
        raise ValueError(f"{name}: got a correlation between contacts, wanted a matrix of its own components")
    if not _known(given.spread <= quantity.most):
        raise ValueError(f"{name}: got {given.spread}, wanted radians, at most {quantity.most:.2f}")


def _refuse(name: str, got: Any, wrong: bool, wanted: str) -> None:
    if wrong:
        raise ValueError(f"{name}: got {got}, wanted {wanted}")


def _known(condition: jax.Array) -> bool:
    """Whether a condition holds everywhere, as far as that is known while JAX traces."""
    return isinstance(condition, Tracer) or bool(np.all(np.asarray(condition)))
