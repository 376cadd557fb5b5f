"""What is drawn of one grasp, as triangles: contacts, friction cones, forces, the worst disturbance."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgb

from jaxgrasp.viewer.bodies import Bodies
from jaxgrasp.viewer.browser.what_if import Answer, Reasons
from jaxgrasp.viewer.grasp import CONTACT_COLOURS
from jaxgrasp.viewer.solids import surface_of_revolution

Colour = tuple[float, float, float]
HAND, OBJECT, BINDING, DISTURBANCE, LOAD = (
    (0.55, 0.62, 0.72),
    (0.86, 0.79, 0.64),
    (0.80, 0.05, 0.05),
    (0.10, 0.10, 0.10),
    (0.45, 0.30, 0.65),
)
# Of hand and object: what is in them and behind them is seen.
OPACITY = 0.65
# Sizes in units of the farthest contact's distance from the centre of mass.
_CONE, _BALL, _LONGEST, _WORST = 0.5, 0.045, 0.9, 1.6
_SHAFT, _HEAD, _HEAD_LENGTH = 0.018, 0.05, 0.14
_AROUND = 20
_ARC = np.linspace(-np.pi / 2, np.pi / 2, 9)
_HALF_CIRCLE = np.stack([np.cos(_ARC), np.sin(_ARC)], -1)
_RING = np.linspace(0, 2 * np.pi, 9)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A surface of one colour."""

    name: str
    """What it is; parts of one kind have its name before a slash."""
    triangles: Float[np.ndarray, "triangles 3 3"]
    """Object frame about the centre of mass, m, corners counterclockwise from outside."""
    colour: Colour
    """Red, green and blue, 0 to 1."""
    opacity: float = 1.0
    """0 to 1."""


def contact_colour(number: int) -> Colour:
    """The colour of a contact, its force and its cone."""
    return to_rgb(CONTACT_COLOURS[number % len(CONTACT_COLOURS)])


def contact_shapes(answer: Answer, reach: float, binding: int | None = None) -> Iterator[Shape]:
    """Contacts as balls, of which the binding one is larger and red, and their friction cones outside the object.

    Args:
        answer: The grasp.
        reach: How far its farthest contact is from the centre of mass, m.
        binding: The contact that ends the margin.
    """
    for number in _drawable(answer):
        point, normal, colour = answer.positions[number], answer.normals[number], contact_colour(number)
        ends = number == binding
        ball = (2 if ends else 1) * _BALL * reach * surface_of_revolution(_HALF_CIRCLE, _AROUND)
        yield Shape(name=f"contacts/{number}", triangles=ball + point, colour=BINDING if ends else colour)
        # Of equal slant: a cone of wide friction would otherwise dwarf the grasp.
        height = _CONE * reach / np.hypot(1.0, answer.friction[number])
        cone = surface_of_revolution(np.array([[0.0, 0], [height * answer.friction[number], height]]), _AROUND)
        yield Shape(name=f"cones/{number}", triangles=_along(cone, normal) + point, colour=colour, opacity=0.25)


def force_shapes(
    answer: Answer, forces: Float[np.ndarray, "contacts 3"], reach: float, scale: float
) -> Iterator[Shape]:
    """Forces of the fingers as arrows with their tips at the contacts.

    Args:
        answer: The grasp.
        forces: On the object in its frame, N; NaN draws none.
        reach: As for `contact_shapes`.
        scale: N for each m of the drawing.
    """
    for number in _drawable(answer):
        force = forces[number]
        if np.isfinite(force).all() and np.linalg.norm(force) > 0:
            tail = answer.positions[number] - force / scale
            arrow = arrow_between(tail, answer.positions[number], reach)
            yield Shape(name=f"forces/{number}", triangles=arrow, colour=contact_colour(number))


def disturbance_shapes(reasons: Reasons, reach: float, size: float = 1.0) -> Iterator[Shape]:
    """The worst disturbance at the centre of mass: its force as an arrow, its moment as a ring about an arrow.

    Args:
        reasons: What it is.
        reach: As for `contact_shapes`.
        size: The part of the longest arrow, 0 to 1.
    """
    force, moment = reasons.direction[:3], reasons.direction[3:]
    if not np.isfinite(reasons.direction).all() or size <= 0:
        return
    for name, vector in (("force", force), ("moment", moment)):
        length = np.linalg.norm(vector)
        if length > 0:
            tip = size * _WORST * reach * vector / length
            yield Shape(name=f"worst/{name}", triangles=arrow_between(np.zeros(3), tip, reach), colour=DISTURBANCE)
            if name == "moment":
                around = np.stack([0.25 + 0.02 * np.cos(_RING), 0.02 * np.sin(_RING)], -1) * reach
                ring = _along(surface_of_revolution(around, _AROUND), vector / length) + tip / 2
                yield Shape(name="worst/ring", triangles=ring, colour=DISTURBANCE)


def load_shape(force: Float[np.ndarray, "3"], reach: float, name: str = "load") -> Shape | None:
    """A load at the centre of mass as an arrow of one length; None where there is none.

    Args:
        force: N, object frame.
        reach: As for `contact_shapes`.
        name: What it is called.
    """
    size = np.linalg.norm(force)
    if not size > 0:
        return None
    return Shape(name=name, triangles=arrow_between(np.zeros(3), 1.4 * reach * force / size, reach), colour=LOAD)


def body_shapes(bodies: Bodies) -> list[Shape]:
    """Hand and object in their first configuration, one shape a body."""
    return [
        Shape(
            name=f"{'object' if of_object else 'hand'}/{name}",
            triangles=surface,
            colour=OBJECT if of_object else HAND,
            opacity=OPACITY,
        )
        for name, of_object, surface in zip(bodies.names, bodies.of_object, bodies.surfaces, strict=True)
    ]


def newtons_per_metre(forces: Float[np.ndarray, "contacts 3"], reach: float) -> float:
    """The scale with which the longest force of a grasp is an arrow of a known length; 1 without forces."""
    longest = float(np.nan_to_num(np.linalg.norm(forces, axis=-1)).max(initial=0.0))
    return longest / (_LONGEST * reach) if longest > 0 else 1.0


def arrow_between(tail: np.ndarray, tip: np.ndarray, reach: float) -> Float[np.ndarray, "triangles 3 3"]:
    """The surface of an arrow, m, as thick as suits a grasp of that reach."""
    way = tip - tail
    length = float(np.linalg.norm(way))
    head = min(_HEAD_LENGTH * reach, 0.5 * length)
    shaft, wide = _SHAFT * reach, _HEAD * head / _HEAD_LENGTH
    profile = np.array([[0, 0], [shaft, 0], [shaft, length - head], [wide, length - head], [0, length]])
    return _along(surface_of_revolution(profile, 12), way / length) + tail


def _drawable(answer: Answer) -> list[int]:
    sound = np.isfinite(answer.positions).all(-1) & np.isfinite(answer.normals).all(-1) & np.isfinite(answer.friction)
    return np.flatnonzero(answer.active & sound).tolist()


def _along(triangles: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Turned so that z becomes a unit direction."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first)
    return triangles @ np.stack([first, np.cross(direction, first), direction])
