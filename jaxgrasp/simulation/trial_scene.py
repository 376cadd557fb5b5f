"""The scene of a protocol: a hand on a mocap base, an object at a scale, and the protocol's own engine and contacts."""

import warnings

import mujoco

from jaxgrasp.hands import HandObject, Scene
from jaxgrasp.simulation.protocols import Course, Hold

_ENGINE = {"integrator": mujoco.mjtIntegrator, "cone": mujoco.mjtCone}
_PREFIX = {"integrator": "mjINT_", "cone": "mjCONE_"}
_OBJECT = "object"


def trial_scene(course: Course | Hold, hand: mujoco.MjSpec, object: str, scale: float) -> Scene:
    """Builds the scene of a protocol.

    Args:
        course: Of the protocol.
        hand: The hand's specification.
        object: As in `Scene.build`.
        scale: Of the object's lengths.

    Raises:
        ValueError: Hand or object cannot be used.
    """
    built = Scene.build(
        hand=hand,
        object=object,
        scale=scale,
        mass=course.mass,
        density=course.density,
        friction=course.friction,
        torsional_friction=course.torsional_friction,
        condim=course.condim,
        base="mocap",
        gravity=course.gravity if isinstance(course, Hold) else (0.0, 0.0, 0.0),
    )
    spec = built.spec
    gravity = spec.option.gravity.copy()
    _set_engine(spec, course)
    spec.option.gravity = gravity
    for geom in spec.geoms:
        if geom.parent.name == _OBJECT:
            continue
        if course.hand_solref is not None:
            geom.solref[:] = course.hand_solref
        if course.hand_solimp is not None:
            geom.solimp[:3] = course.hand_solimp
    return Scene(spec=spec, model=spec.compile())


def hand_of(scene: Scene, **options) -> HandObject:
    """The hand and the object of a scene of a protocol; `options` are those of `HandObject.from_mjcf`.

    That margins leave rolling friction out is no news where a protocol asks for it, and is not warned of.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="scene: contacts have condim")
        return scene.hand_object(**options)


def _set_engine(spec: mujoco.MjSpec, course: Course | Hold) -> None:
    """Sets all of MuJoCo's options: the protocol's, and its defaults for the rest."""
    plain = mujoco.MjSpec().option
    for name in (n for n in dir(plain) if not n.startswith("_")):
        setattr(spec.option, name, getattr(plain, name))
    spec.option.timestep = course.timestep
    spec.option.impratio = course.impratio
    spec.option.noslip_iterations = course.noslip_iterations
    for name, kinds in _ENGINE.items():
        setattr(spec.option, name, getattr(kinds, _PREFIX[name] + getattr(course, name).upper()))
    if not course.multiccd:
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
