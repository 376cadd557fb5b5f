"""Shapes in the scene of one browser, by kinds that are shown and hidden together."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxgrasp.viewer.bodies import Bodies
from jaxgrasp.viewer.browser.shapes import HAND, OBJECT, OPACITY, Shape

UNITS = 10.0
"""Units of the browser's scene for each m: cameras stand well where a grasp is about one unit large."""
# Size of dots, in units of the farthest contact's distance from the centre of mass.
_DOT = 0.012


class Stage:
    """Where one grasp is drawn."""

    def __init__(self, scene: Any, name: str, offset: Float[np.ndarray, "3"] | None = None):
        """Makes room for a grasp.

        Args:
            scene: Of one browser, viser's `SceneApi`.
            name: Which tells it from other grasps there.
            offset: Where its centre of mass is, m; None is the scene's origin.
        """
        self._scene, self._name = scene, name
        self._root = scene.add_frame(f"/{name}", show_axes=False)
        if offset is not None:
            self._root.position = offset * UNITS
        self._kinds: dict[str, Any] = {}
        self._drawn: dict[str, dict[str, Any]] = {}
        self._moving: list[Any] = []

    def draw(self, kind: str, shapes: Iterable[Shape]) -> None:
        """Draws shapes in place of those that were drawn of a kind."""
        self._kind(kind)
        before, self._drawn[kind] = self._drawn.get(kind, {}), {}
        for shape in shapes:
            name = f"/{self._name}/{kind}/{shape.name}"
            self._drawn[kind][name] = self._mesh(name, shape.triangles, shape.colour, shape.opacity)
        for name in before.keys() - self._drawn[kind].keys():
            before[name].remove()

    def label(self, kind: str, texts: Iterable[tuple[str, Float[np.ndarray, "3"]]]) -> None:
        """Writes texts at points, m, in place of those of a kind."""
        self._kind(kind)
        before, self._drawn[kind] = self._drawn.get(kind, {}), {}
        for number, (text, point) in enumerate(texts):
            name = f"/{self._name}/{kind}/{number}"
            self._drawn[kind][name] = self._scene.add_label(name, text, position=point * UNITS, anchor="center-center")
        for name in before.keys() - self._drawn[kind].keys():
            before[name].remove()

    def dots(self, kind: str, points: Float[np.ndarray, "points 3"], reach: float) -> None:
        """Draws points, m, as small dots in place of those of a kind, `reach` m being the size of the grasp."""
        self._kind(kind)
        name = f"/{self._name}/{kind}/all"
        colours = np.full((len(points), 3), 185, np.uint8)
        self._scene.add_point_cloud(
            name, np.asarray(points * UNITS, np.float32), colours, point_size=_DOT * reach * UNITS, point_shape="circle"
        )

    def bodies(self, kind: str, bodies: Bodies) -> None:
        """Puts hand and object there, in place of those of a kind; `move` moves them."""
        self._moving = []
        for handle in self._drawn.pop(kind, {}).values():
            handle.remove()
        self._kind(kind)
        self._drawn[kind] = {}
        for number, (name, of_object) in enumerate(zip(bodies.names, bodies.of_object, strict=True)):
            part = f"/{self._name}/{kind}/{'object' if of_object else 'hand'} {name}"
            frame = self._scene.add_frame(part, show_axes=False)
            self._mesh(f"{part}/surface", bodies.triangles[number], OBJECT if of_object else HAND, OPACITY)
            self._drawn[kind][part] = frame
            self._moving.append(frame)
        self.move(bodies, 0)

    def move(self, bodies: Bodies, frame: int) -> None:
        """Moves what `bodies` has drawn to where it is in a frame."""
        for number, handle in enumerate(self._moving):
            handle.position = bodies.positions[frame, number] * UNITS
            handle.wxyz = _quaternion(bodies.rotations[frame, number])

    def show(self, kind: str, visible: bool) -> None:
        """Shows or hides a kind."""
        self._kind(kind).visible = visible

    def remove(self) -> None:
        """Takes everything away."""
        self._root.remove()

    def _kind(self, kind: str) -> Any:
        if kind not in self._kinds:
            self._kinds[kind] = self._scene.add_frame(f"/{self._name}/{kind}", show_axes=False)
        return self._kinds[kind]

    def _mesh(self, name: str, triangles: np.ndarray, colour: tuple[float, float, float], opacity: float) -> Any:
        corners = np.asarray(triangles.reshape(-1, 3) * UNITS, np.float32)
        faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        return self._scene.add_mesh_simple(
            name,
            corners,
            faces,
            color=colour,
            opacity=None if opacity == 1.0 else opacity,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Unit quaternion (w, x, y, z) of a rotation."""
    # The column of q q' with the largest diagonal loses no digits.
    r = rotation
    squares = np.array([1 + np.trace(r), *(1 + 2 * np.diag(r) - np.trace(r))])
    others = np.zeros((4, 4))
    others[0, 1:] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    others[1, 2], others[1, 3], others[2, 3] = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    products = others + others.T + np.diag(squares)
    column = products[int(squares.argmax())]
    return column / np.linalg.norm(column)
