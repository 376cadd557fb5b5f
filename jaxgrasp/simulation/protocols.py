"""Named, versioned ways to try grasps in C MuJoCo, with every parameter that decides what holds.

A protocol that is changed gets another version: numbers of the same name and version can be compared.
"""

import json
from dataclasses import asdict, dataclass

DIRECTIONS = {
    "-x": (-1.0, 0.0, 0.0),
    "+x": (1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
    "+z": (0.0, 0.0, 1.0),
}
"""Of loads, world frame."""


@dataclass(frozen=True, kw_only=True)
class Course:
    """A hand that grasps, squeezes and is then loaded along six directions, each from the state after the squeeze."""

    timestep: float = 0.004
    """s. Options of MuJoCo that are not here have its defaults, whatever the hand's file says."""
    integrator: str = "implicitfast"
    cone: str = "elliptic"
    impratio: float = 10.0
    noslip_iterations: int = 2
    multiccd: bool = False
    """Whether a pair of convex geoms may have several contact points."""
    condim: int = 4
    friction: float = 0.6
    torsional_friction: float = 0.02
    """m."""
    hand_solref: tuple[float, float] | None = (0.005, 1.0)
    """Of the hand's geoms; None keeps the file's."""
    hand_solimp: tuple[float, float, float] | None = (0.5, 0.99, 0.0001)
    mass: float | None = 0.1
    """kg, or None and"""
    density: float | None = None
    """kg/m^3."""
    start: str = "pregrasp"
    """Where the hand begins, at rest; its base is welded to a mocap body. Nothing has weight."""
    stages: tuple[str, ...] = ("grasp", "squeeze")
    """Where it then goes: commands of the actuators evenly, by their transmission at the start, the base by slerp. A
    stage that grasps do not have is the grasp."""
    commands_per_stage: int = 10
    steps_per_command: int = 10
    load: float = 1.0
    """N on the object's centre of mass, world frame; or"""
    load_acceleration: float | None = None
    """m/s^2, times the object's mass."""
    load_directions: tuple[str, ...] = tuple(DIRECTIONS)
    load_seconds: float = 2.0
    check_seconds: float = 0.2
    """How often the object is looked at."""
    stop_at_failure: bool = True
    """Whether loads after the first that the grasp does not bear are left out."""
    needed_loads: int = 6
    """Of how many the grasp must bear."""
    max_displacement: float | None = 0.05
    """m, of the object's frame from where the file has it, below which it counts as held; None for any."""
    max_rotation: float | None = 15.0
    """Degrees, likewise."""
    must_touch: bool = False
    """Whether hand and object must touch when they are looked at."""
    max_penetration: float | None = 0.01
    """m. Grasps with hand and object, or the hand and itself, deeper in each other at the start or in the grasp are not
    tried and not held."""


@dataclass(frozen=True, kw_only=True)
class Hold:
    """`hold_trials` as it is: see there for how commands and loads rise, and when an object has stayed."""

    timestep: float = 0.001
    """s."""
    integrator: str = "implicitfast"
    cone: str = "elliptic"
    impratio: float = 100.0
    noslip_iterations: int = 0
    multiccd: bool = True
    condim: int = 3
    friction: float = 0.8
    torsional_friction: float | None = None
    hand_solref: tuple[float, float] | None = None
    hand_solimp: tuple[float, float, float] | None = None
    mass: float | None = 0.1
    density: float | None = None
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """m/s^2; the hand has no weight."""
    push: float = 0.981
    """N, beside the weight."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A course with a name."""

    name: str
    version: int
    about: str
    """What it is, in a line."""
    course: Course | Hold

    def parameters(self) -> dict[str, object]:
        """All parameters by name, name and version first."""
        return {"protocol": self.name, "version": self.version, **asdict(self.course)}

    def as_json(self) -> str:
        """The same as a line of JSON."""
        return json.dumps(self.parameters())


PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            name="dexgraspbench-fc",
            version=1,
            about="DexGraspBench's setting fc: pre-grasp, grasp, squeeze, then 1 N along six directions for 2 s each",
            course=Course(),
        ),
        Protocol(
            name="jaxgrasp-hold",
            version=1,
            about="starts in the grasp: squeeze, weight, and six pushes of the weight's size for 0.5 s each",
            course=Hold(),
        ),
        Protocol(
            name="six-gravities",
            version=1,
            # The validator's engine is not MuJoCo, and it moves contact points 1 mm inwards where this squeezes.
            about="like DexGraspNet's validator: gravity along six directions, 500 kg/m^3, friction 3, must touch",
            course=Course(
                # Its steps are of 1/120 s; MuJoCo's contacts need shorter ones.
                timestep=1 / 480,
                friction=3.0,
                mass=None,
                density=500.0,
                start="grasp",
                stages=("squeeze",),
                load_acceleration=9.8,
                load_seconds=100 / 60,
                check_seconds=10 / 60,
                max_displacement=None,
                max_rotation=None,
                must_touch=True,
                max_penetration=0.001,
            ),
        ),
        Protocol(
            name="six-pulls",
            version=1,
            about="like GraspQP's trial: 3 N along six directions, of which at least three must be borne",
            course=Course(
                start="grasp", stages=("squeeze",), load=3.0, stop_at_failure=False, needed_loads=3, max_rotation=None
            ),
        ),
    )
}
"""Every protocol by its name."""


def protocol_named(name: str) -> Protocol:
    """The protocol of a name.

    Raises:
        ValueError: There is none.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"protocol: got {name!r}; wanted one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]
