"""Which program finds contacts: what an engine answers, which ones there are, and which is taken when.

| engine | finds contacts | for |
|---|---|---|
| mujoco | C MuJoCo's collision, in a pool of threads; every kind of geom, nothing is compiled | ranking and judging |
| distance | signed distances, compiled by JAX | derivatives, jit and vmap, accelerators |
| mjx | MJX's collision, compiled by JAX; of boxes and meshes only where they penetrate | jit and vmap, accelerators |
"""

from typing import Any, NamedTuple, Protocol

import jax
from jax.core import Tracer

from jaxgrasp.hands.link_contacts import RawPoints

ENGINES = ("mujoco", "distance", "mjx")


class Geometry(NamedTuple):
    """What an engine finds in n configurations; world frame, in NumPy's or JAX's arrays."""

    points: RawPoints
    """Where hand and object touch or come near, at least up to the contact distance."""
    object_rotation: Any
    """(n, 3, 3), columns are the axes of the object's frame."""
    object_position: Any
    """(n, 3), its centre of mass, m."""
    anchors: Any
    """(n, joints, 3), a point on the axis of each of the hand's joints, m."""
    axes: Any
    """(n, joints, 3), their directions, unit."""
    lengths: Any
    """(n, actuators), of the hand's actuators, rad or m."""
    moments: Any
    """(n, dofs, actuators), B of all the hand's degrees of freedom, or (dofs, actuators) where it does not vary."""
    springs: Any
    """(n, dofs), torques of the springs of joints and tendons, N m or N."""


class Engine(Protocol):
    """Finds contacts; made of a scene, the bodies of hand and object, and the joints and actuators of the hand."""

    differentiable: bool
    """True if derivatives pass through `find`; stops of joints, whose torques jump, then do not count."""

    def find(self, qpos: Any) -> Geometry:
        """What is where in configurations (n, nq), which are finite."""
        ...


def engine_for(given: str | None, qpos: Any) -> str:
    """The engine that answers.

    MuJoCo's cannot be differentiated or compiled, and would wait for an accelerator's data: it is taken where JAX runs
    on CPUs and `qpos` is no tracer. Where it is not, `distance` is, which has derivatives and knows how far geoms are
    apart; `mjx` has to be asked for.

    Args:
        given: What the caller wants; None chooses.
        qpos: The configurations.

    Raises:
        ValueError: There is no such engine, or it cannot answer while JAX traces.
    """
    traced = isinstance(qpos, Tracer)
    if given is None:
        return "distance" if traced or jax.default_backend() != "cpu" else "mujoco"
    if given not in ENGINES:
        raise ValueError(f"engine: got {given!r}, wanted one of {', '.join(ENGINES)}")
    if traced and given == "mujoco":
        raise ValueError("engine: got 'mujoco' inside jit, vmap or grad, wanted 'distance' or 'mjx' there")
    return given
