"""The options by which subcommands take a hand and an object, from one scene or each from its own file."""

import functools
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxgrasp.cli.checks import check_options
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.streams import notice
from jaxgrasp.storage import printable

if TYPE_CHECKING:
    from jaxgrasp import hands
    from jaxgrasp.hands import HandObject

BUILT_IN = ("shadow_hand", "four_fingers")
# A mesh that fills less of its convex hull is not nearly convex.
_CONVEX = 0.95
# Options that a scene of a file answers itself.
_OF_BUILT = ("mass", "density", "torsional_friction", "condim", "gravity_vector", "table")


@functools.cache
def _read_hand(name: str) -> Any:
    """The specification of a hand, read once for the scenes of all scales."""
    from jaxgrasp.hands.hand_files import read_spec
    from jaxgrasp.hands.hand_names import hand_file

    return read_spec("hand", hand_file(name))


@dataclass(frozen=True, kw_only=True)
class HandScene:
    """A hand and an object."""

    scene: str | None = None
    """A hand and an object in MJCF: a file, or shadow_hand or four_fingers, which come with the package."""

    object_body: str = "object"
    """The object's body in the scene."""

    object_shape: str = "sphere"
    """The object of a scene that comes with the package: sphere, capsule, box, cylinder, ellipsoid, mesh, or a FILE."""

    hand: str | None = None
    """A hand of your own in place of --scene, with --object: an MJCF or URDF file, shadow_hand or four_fingers,
    FOLDER/FILE of a local copy of mujoco_menagerie, or an entry of robot_descriptions that was downloaded before."""

    mass: float | None = None
    """With --hand: of the object, kg; None is that of the file, or of water."""

    density: float | None = None
    """With --hand: of the object, kg/m^3, in place of --mass."""

    torsional_friction: float | None = None
    """With --hand: of every contact, m; None keeps the models'."""

    condim: int | None = None
    """With --hand: MuJoCo's dimension of every contact, 1, 3, 4 or 6; None keeps the models'."""

    base: str = "free"
    """With --hand: how the frame of the hand file's world stands in the world: free, fixed or mocap."""

    gravity_vector: tuple[float, float, float] | None = None
    """With --hand: gravity in the world, m/s^2, which the object's weight is borne in; None keeps the hand file's."""

    table: float | None = None
    """With --hand: height of a horizontal plane, which is no finger, m; None for none."""

    hand_body: str | None = None
    """The hand's first body; None is what joints move, and what these hang on."""

    environment: tuple[str, ...] = ()
    """Bodies that are not the hand's; with --hand also an MJCF FILE of what stands around."""

    contact_distance: float = 5e-3
    """Geoms no farther apart than this touch, m."""

    max_contacts: int | None = None
    """Of how many links a grasp keeps the contacts, the nearest ones; None for all."""

    points_per_link: int = 1
    """1 makes one contact of each link, at the mean of its near points; more are as many points, spread apart."""

    unreached: str = "held"
    """What joint directions do that nothing drives: held bear any torque, free none."""

    engine: str | None = None
    """What finds contacts: mujoco, distance, or mjx (what touches or penetrates, with --contact-distance 0); None takes
    mujoco on CPUs, distance elsewhere."""

    picture: Path | None = Path("hands.png")
    """The rendered picture of the best configurations to write, .png; None for none."""

    def check(self) -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        from jaxgrasp.hands.engines import ENGINES
        from jaxgrasp.hands.mechanics import UNREACHED

        most, engines = self.max_contacts, ", ".join(ENGINES)
        check_options(
            ("--contact-distance", self.contact_distance, 0.0 <= self.contact_distance < math.inf, "metres >= 0"),
            ("--max-contacts", most, most is None or most >= 1, "at least 1"),
            ("--points-per-link", self.points_per_link, self.points_per_link >= 1, "at least 1"),
            ("--unreached", self.unreached, self.unreached in UNREACHED, " or ".join(UNREACHED)),
            ("--engine", self.engine, self.engine in (None, *ENGINES), f"one of {engines}"),
        )
        if self.scene and self.hand:
            raise CommandError("--hand: got --scene, too; wanted one of them")
        if self.scene:
            alone = {name: getattr(self, name) for name in _OF_BUILT if getattr(self, name) is not None}
            for name in alone:
                raise CommandError(f"--{name.replace('_', '-')}: got --scene, too; wanted --hand and --object with it")

    @property
    def given(self) -> bool:
        """Whether there is a hand at all."""
        return bool(self.scene or self.hand)

    @property
    def name(self) -> str:
        """What the hand is called."""
        return self.scene or self.hand or ""

    @property
    def built_in(self) -> bool:
        """Whether the scene comes with the package."""
        return self.scene in BUILT_IN

    def built(self, object: str, scale: float, friction: float | None) -> "hands.Scene":
        """The scene of --hand and an object.

        Raises:
            CommandError: It cannot be built.
        """
        from jaxgrasp.hands import Scene as Built

        assert self.hand is not None
        files = [name for name in self.environment if Path(name).suffix]
        if len(files) > 1:
            raise CommandError(f"--environment: got {len(files)} files; wanted one")
        _tell_of_hollows(Path(object))
        try:
            return Built.build(
                hand=_read_hand(self.hand),
                object=object,
                scale=scale,
                friction=friction,
                gravity=self.gravity_vector,
                environment=files[0] if files else None,
                **{name: getattr(self, name) for name in ("base", *_OF_BUILT) if name != "gravity_vector"},
            )
        except ValueError as error:
            raise CommandError(f"--{' '.join(str(error).split())}") from error

    def hand_of(self, scene: Any, friction: float | None, max_force: float | None) -> "HandObject":
        """The hand and the object of a scene; what is not modelled is noted.

        Raises:
            CommandError: It cannot be used.
        """
        from jaxgrasp.hands import HandObject
        from jaxgrasp.hands.engines import engine_for

        try:
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                hand = HandObject.from_mjcf(
                    scene,
                    self.object_body,
                    hand_body=self.hand_body,
                    environment=[name for name in self.environment if not (self.hand and Path(name).suffix)],
                    contact_distance=self.contact_distance,
                    points_per_link=self.points_per_link,
                    max_contacts=self.max_contacts,
                    unreached=self.unreached,
                    friction=friction,
                    max_force=10.0 if max_force is None else max_force,
                )
                # What the engine cannot find is told before long work.
                hand.engine(engine_for(self.engine, None))
        except (ValueError, OSError) as error:
            raise CommandError(f"{self.name}: {' '.join(str(error).split())}") from error
        for warning in told:
            notice(warning.message)
        return hand

    def hand_object(self, friction: float | None, max_force: float | None) -> "HandObject":
        """Reads the scene.

        Args:
            friction: Of all contacts; None is MuJoCo's.
            max_force: Of every contact, N.

        Raises:
            CommandError: It cannot be used.
        """
        from jaxgrasp.hands import scenes

        assert self.scene is not None
        try:
            given = getattr(scenes, self.scene)(self.object_shape) if self.built_in else Path(self.scene)
        except (ValueError, OSError) as error:
            raise CommandError(f"--scene {self.scene}: {' '.join(str(error).split())}") from error
        return self.hand_of(given, friction, max_force)


@functools.cache
def _convexity(path: Path) -> float:
    """The share of its hull that the mesh of a file fills, found once for the scenes of all scales; 1 if not known."""
    from jaxgrasp.geometry import Mesh, MeshError, convexity

    try:
        with warnings.catch_warnings(action="ignore"):
            mesh = Mesh.from_file(path)
        return convexity(mesh) if mesh.is_closed else 1.0
    except MeshError:
        # MuJoCo reads it by itself, and says what it lacks.
        return 1.0


def _tell_of_hollows(object: Path) -> None:
    """Notes where a mesh is not convex, since its hull is what touches."""
    if object.suffix.lower() not in (".obj", ".stl") or not object.is_file():
        return
    filled = _convexity(object)
    if filled < _CONVEX:
        notice(
            f"{printable(str(object))}: its convex hull is what touches, and it fills {filled:.0%} of that; "
            "`jaxgrasp pieces` takes it apart"
        )
