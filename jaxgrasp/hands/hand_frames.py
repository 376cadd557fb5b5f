"""Where the links of a hand stand in the world of its file, and in which orders others count its joints."""

from dataclasses import dataclass
from os import PathLike

import mujoco
import numpy as np

from jaxgrasp.hands.hand_files import read_spec
from jaxgrasp.hands.hand_names import hand_file

_MOVING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True, eq=False)
class HandFrames:
    """A hand in its reference configuration."""

    model: mujoco.MjModel
    """The hand alone, with every link of its file."""

    @classmethod
    def of(cls, hand: str | PathLike | mujoco.MjSpec) -> "HandFrames":
        """Reads a hand.

        Args:
            hand: An MJCF or URDF file, a specification, or a name that `hand_names.hand_file` knows.

        Raises:
            ValueError: It cannot be read.
        """
        spec = hand.copy() if isinstance(hand, mujoco.MjSpec) else read_spec("hand", hand_file(hand))
        # MuJoCo leaves out links of URDF files that no joint moves, which files of grasps name.
        spec.compiler.fusestatic = False
        try:
            return cls(spec.compile())
        except ValueError as error:
            raise ValueError(f"hand: it cannot be used: {' '.join(str(error).split())}") from error

    def pose(self, link: str | None = None) -> np.ndarray:
        """Pose (7,) of a link in the world of the hand's file, m and w first.

        Args:
            link: Its name, "world" for the world itself; None for the first one, which all others hang on. Where
                several stand in the world, that is the world, too.

        Raises:
            LookupError: There is none of this name, or the hand's joints move it.
        """
        model = self.model
        if link is None:
            first = np.flatnonzero(model.body_parentid[1:] == 0) + 1
            body = int(first[0]) if len(first) == 1 and not model.body_jntnum[first[0]] else 0
        else:
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link)
            if body < 0:
                names = ", ".join(model.body(k).name for k in range(1, model.nbody) if not model.body_weldid[k])
                raise LookupError(f"no link {link!r} among those of the hand ({names})")
            if model.body_weldid[body]:
                raise LookupError(f"the link {link!r}, which joints of the hand move")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        return np.concatenate([data.xpos[body], data.xquat[body]])

    def has(self, link: str) -> bool:
        """Whether there is a link of a name."""
        return mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, link) >= 0

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of hinges and slides, in the order of the file."""
        return tuple(self.model.joint(j).name for j in self._moving)

    @property
    def joints_by_level(self) -> tuple[str, ...]:
        """The same, those of bodies nearer to the world first, as PhysX and Isaac Sim count them."""
        level = np.zeros(self.model.nbody, int)
        for body in range(1, self.model.nbody):
            level[body] = level[self.model.body_parentid[body]] + 1
        moving = self._moving
        order = np.argsort(level[self.model.jnt_bodyid[moving]], kind="stable")
        return tuple(self.model.joint(int(j)).name for j in moving[order])

    @property
    def _moving(self) -> np.ndarray:
        return np.flatnonzero(np.isin(self.model.jnt_type, _MOVING))
