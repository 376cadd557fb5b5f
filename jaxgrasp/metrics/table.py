"""All metrics by name, each with what it needs and which end of it is the good one."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.metrics.closure import force_closure, min_weight
from jaxgrasp.metrics.hulls import wrench_space_volume
from jaxgrasp.metrics.largest_ball import ferrari_canny_bound
from jaxgrasp.metrics.matrices import closure_residual, isotropy, smallest_singular_value
from jaxgrasp.metrics.nearest_facet import ferrari_canny
from jaxgrasp.metrics.task import task_wrench
from jaxgrasp.metrics.wrench_space import WrenchSpace
from jaxgrasp.robustness import largest_disturbance
from jaxgrasp.robustness.chain.formulations import formulation_margin, is_refined
from jaxgrasp.solvers.status import Status


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is asked of the grasps, beside their contacts."""

    disturbances: DisturbanceSet
    """The set that the margin and the task wrenches scale."""
    cone_edges: int = 8
    """n_e."""
    task: Mapping[str, Any]
    """Further arguments of `largest_disturbance`: required_wrench, actuation."""

    @property
    def space(self) -> WrenchSpace:
        """Normal components of 1, moments over the grasp's own size, about the centre of mass."""
        return WrenchSpace(cone_edges=self.cone_edges)


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One measure of grasps."""

    name: str
    about: str
    """What it is, in a few words."""
    value: Callable[[Contacts, Setting], Any]
    """(*batch,) of a batch, or a float of one grasp."""
    batched: bool = True
    """True if `value` takes contacts with batch axes, False if one grasp alone."""
    traceable: bool = True
    """False if `value` runs programs by itself, outside of any `jax.jit`."""
    formulation: str | None = None
    """The formulation of `formulation_margin` whose margin it is."""
    larger_is_better: bool = True

    def under_jit(self, disturbances: DisturbanceSet) -> bool:
        """Whether it takes a batch under `jax.jit` with this set."""
        return (
            self.batched
            and self.traceable
            and (self.formulation is None or not is_refined(disturbances, self.formulation))
        )


def _margin(contacts: Contacts, setting: Setting) -> jax.Array:
    found = largest_disturbance(contacts, setting.disturbances, cone_edges=setting.cone_edges, **setting.task)
    return _verified(found.margin, found.status)


def _verified(margin: jax.Array, status: jax.Array) -> jax.Array:
    """The margin, NaN where the audit did not confirm the answer: such grasps count as the worst."""
    return jnp.where(status == Status.NOT_VERIFIED, jnp.nan, margin)


def _margin_of(formulation: str) -> Callable[[Contacts, Setting], jax.Array]:
    # These programs have rows of contacts alone: what actuators cannot do is not asked.
    def value(contacts: Contacts, setting: Setting) -> jax.Array:
        load = setting.task.get("required_wrench")
        found = formulation_margin(
            contacts, setting.disturbances, formulation, required_wrench=load, cone_edges=setting.cone_edges
        )
        # A margin that its bounds do not tell from zero is rounding, by which grasps would be ranked.
        rounding = jnp.abs(found.margin) <= found.upper_bound - found.margin
        return _verified(jnp.where(rounding, 0, found.margin), found.status)

    return value


def _closed(contacts: Contacts, setting: Setting) -> jax.Array:
    found = force_closure(contacts, setting.space)
    return jnp.where(jnp.isnan(found.min_weight), jnp.nan, found.closed)


METRICS = {
    metric.name: metric
    for metric in (
        Metric(name="margin", about="robustness margin (21)", value=_margin),
        Metric(name="margin_12", about="largest disturbance by (12)", value=_margin_of("12"), formulation="12"),
        Metric(
            name="margin_12_fixed",
            about="by (12) with blocking forces",
            value=_margin_of("12_fixed"),
            formulation="12_fixed",
        ),
        Metric(name="margin_13", about="by (13)", value=_margin_of("13"), formulation="13"),
        Metric(name="margin_16", about="by (16)", value=_margin_of("16"), formulation="16"),
        Metric(
            name="margin_per_direction",
            about="the smallest over the directions, each with forces of its own",
            value=_margin_of("per_direction"),
            formulation="per_direction",
        ),
        Metric(
            name="margin_per_direction_prestrained",
            about="the same with blocking forces",
            value=_margin_of("per_direction_prestrained"),
            formulation="per_direction_prestrained",
        ),
        Metric(
            name="ferrari_canny",
            about="largest ball in the wrench space, sum of normal forces 1",
            value=lambda c, s: ferrari_canny(c, "L1", s.space),
            traceable=False,
        ),
        Metric(
            name="ferrari_canny_bound",
            about="upper bound of ferrari_canny, mostly itself (differentiable)",
            value=lambda c, s: ferrari_canny_bound(c, "L1", s.space),
        ),
        Metric(
            name="ferrari_canny_linf",
            about="the same, each normal force 1",
            value=lambda c, s: ferrari_canny(c, "Linf", s.space),
            traceable=False,
        ),
        Metric(
            name="ferrari_canny_linf_bound",
            about="upper bound of ferrari_canny_linf (differentiable)",
            value=lambda c, s: ferrari_canny_bound(c, "Linf", s.space),
        ),
        Metric(
            name="min_weight",
            about="largest least weight of edges that cancel",
            value=lambda c, s: min_weight(c, s.space),
        ),
        Metric(
            name="volume",
            about="volume of the wrench space (hull)",
            value=lambda c, s: wrench_space_volume(c, s.space),
            batched=False,
        ),
        Metric(
            name="task_wrench",
            about="largest multiple of the disturbances in the wrench space, sum of normal forces 1",
            value=lambda c, s: task_wrench(c, s.disturbances, s.space),
        ),
        Metric(name="force_closure", about="1 with force closure, else 0", value=_closed),
        Metric(
            name="smallest_singular_value",
            about="of the grasp map",
            value=lambda c, s: smallest_singular_value(c, s.space),
        ),
        Metric(name="isotropy", about="smallest over largest singular value", value=lambda c, s: isotropy(c, s.space)),
        Metric(
            name="closure_residual",
            about="wrench left by unit normal forces, small is good",
            value=lambda c, s: closure_residual(c, s.space),
            larger_is_better=False,
        ),
    )
}
"""Every metric by its name."""
