"""Rendered pictures of hands that hold an object, with the forces of the fingers."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from jaxgrasp.hands.bodies import bodies_below
from jaxgrasp.viewer.grasp import CONTACT_COLOURS, round_scale
from jaxgrasp.viewer.offscreen import offscreen
from jaxgrasp.viewer.ranking import write_figure

_PIXELS = 720
_INCHES = 4.8
_LONGEST_ARROW = 0.04
_ARROW_WIDTH = 0.002
# MuJoCo draws the groups before this one.
_HIDDEN_GROUP = 3
_HAND_ALPHA = 0.35


def draw_scenes(
    path: Path | str,
    model: mujoco.MjModel,
    configurations: Float[np.ndarray, "scenes nq"],
    contact_points: Float[np.ndarray, "scenes contacts 3"],
    forces: Float[np.ndarray, "scenes contacts 3"],
    titles: Sequence[str],
    object_body: int | None = None,
) -> None:
    """Renders some configurations of a hand and an object, one panel each, and writes the picture.

    The hand is half transparent and whole in its panel; the arm that carries its palm is left out. Each finger's force
    on the object is an arrow that ends at the contact, its length proportional to the force. Hands and arrows have the
    same scale in all panels. The view is from the side where the arrows can be seen best.

    Args:
        path: The file; its ending says the format (png, pdf, ...).
        model: Hand and object.
        configurations: The model's `qpos`.
        contact_points: World frame, m.
        forces: Of the fingers on the object, world frame, N. Not drawn where it or the point is NaN or it is zero.
        titles: One a panel.
        object_body: The object's body, with all below it; None is every body with a free joint.

    Raises:
        ValueError: The arrays' shapes do not fit the model and each other, or nothing is the object.
        RuntimeError: No OpenGL context can be had; the message names the remedy.
        OSError: The file cannot be written.
    """
    configurations, contact_points, forces = (
        np.asarray(array, float) for array in (configurations, contact_points, forces)
    )
    _check(model, configurations, contact_points, forces, titles)
    of_object = _of_object(model, object_body)
    if not of_object.any():
        raise ValueError("model: got no body with a free joint and a geom, wanted an object")
    # NaN in the points counts as no force.
    forces = np.where(np.isfinite(contact_points).all(-1, keepdims=True), np.nan_to_num(forces), 0.0)
    strongest = np.linalg.norm(forces, axis=-1).max(initial=0.0)
    newtons_per_mm = round_scale(float(strongest) / (1e3 * _LONGEST_ARROW)) if strongest > 0.0 else np.nan
    arrows = forces / (1e3 * newtons_per_mm) if strongest > 0.0 else forces

    model = for_pictures(model, of_object)
    model.geom_rgba[_of_arm(model, of_object), 3] = 0.0
    panels = [_Panel.of(model, *each) for each in zip(configurations, contact_points, arrows, strict=True)]
    distance = max(panel.distance for panel in panels)
    with offscreen(model, _PIXELS, _PIXELS) as render:
        pictures = [render(_scene(model, panel, distance)) for panel in panels]
    write_figure(_compose(pictures, titles, newtons_per_mm), path)


def _check(
    model: mujoco.MjModel, configurations: np.ndarray, points: np.ndarray, forces: np.ndarray, titles: Sequence[str]
) -> None:
    count = len(titles)
    if count == 0 or configurations.shape != (count, model.nq):
        raise ValueError(f"configurations: got {configurations.shape}, wanted ({count}, {model.nq}), one a title")
    for name, array in (("contact_points", points), ("forces", forces)):
        if array.ndim != 3 or array.shape != (count, points.shape[1], 3):
            raise ValueError(f"{name}: got {array.shape}, wanted ({count}, contacts, 3)")


def _of_object(model: mujoco.MjModel, body: int | None) -> Bool[np.ndarray, " geoms"]:
    if body is not None:
        return np.isin(model.geom_bodyid, bodies_below(model, body))
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    return np.isin(model.body_rootid[model.geom_bodyid], free)


def _of_arm(model: mujoco.MjModel, of_object: Bool[np.ndarray, " geoms"]) -> Bool[np.ndarray, " geoms"]:
    """The geoms of what carries the palm. The palm is the last body that all ends of fingers are below."""
    others = np.setdiff1d(np.arange(1, model.nbody), model.geom_bodyid[of_object])
    ends = np.intersect1d(np.setdiff1d(others, model.body_parentid), model.geom_bodyid)
    carriers = [body for body in others.tolist() if np.isin(ends, bodies_below(model, body)).all()]
    return np.isin(model.geom_bodyid, carriers[:-1])


def for_pictures(
    model: mujoco.MjModel, of_object: Bool[np.ndarray, " geoms"] | None = None, pixels: int = _PIXELS
) -> mujoco.MjModel:
    """A copy that is lit from the camera and through whose hand one can see, for square pictures.

    Args:
        model: Hand and object.
        of_object: Which geoms are the object's; None is those of every body with a free joint.
        pixels: Width and height.
    """
    model = copy(model)
    model.vis.global_.offwidth = model.vis.global_.offheight = pixels
    model.vis.headlight.ambient[:] = 0.45
    model.vis.headlight.diffuse[:] = 0.45
    model.vis.headlight.specular[:] = 0.0
    model.light_active[:] = 0
    hand = ~(_of_object(model, None) if of_object is None else of_object)
    # A geom with a material has its colour from there; materials may be shared with the object, geoms' colours are not.
    for geom in np.flatnonzero(hand).tolist():
        material = model.geom_matid[geom]
        colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        model.geom_rgba[geom] = [*(0.6 * colour[:3] + 0.4), _HAND_ALPHA * colour[3]]
    model.geom_matid[hand] = -1
    return model


@dataclass(frozen=True)
class _Panel:
    """A configuration and how it is seen."""

    data: mujoco.MjData
    tails: Float[np.ndarray, "arrows 3"]
    tips: Float[np.ndarray, "arrows 3"]
    numbers: list[int]
    """Of the contacts that have arrows."""
    view: tuple[float, float]
    """Azimuth and elevation, degrees."""
    centre: Float[np.ndarray, "3"]
    """What the camera looks at, m."""
    distance: float
    """The least from which the camera sees hand, object and arrows whole, m."""

    @classmethod
    def of(cls, model: mujoco.MjModel, configuration: np.ndarray, points: np.ndarray, arrows: np.ndarray) -> "_Panel":
        data = mujoco.MjData(model)
        data.qpos[:] = configuration
        mujoco.mj_forward(model, data)
        drawn = np.flatnonzero(arrows.any(-1))
        tips, tails = points[drawn], (points - arrows)[drawn]
        view = _view(tips - tails)
        # Right, up and forward, as the camera has them.
        a, e = np.radians(view)
        forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([np.sin(a), -np.cos(a), 0.0])
        axes = np.stack([right, np.cross(right, forward), forward])
        seen = np.concatenate([_corners(model, data), tails]) @ axes.T
        middle = 0.5 * (seen.min(0) + seen.max(0))
        sideways = np.abs(seen - middle)[:, :2].max(-1)
        slope = 0.97 * np.tan(np.radians(0.5 * model.vis.global_.fovy))
        distance = (sideways / slope - (seen - middle)[:, 2]).max()
        return cls(data, tails, tips, drawn.tolist(), view, middle @ axes, float(distance))


def _corners(model: mujoco.MjModel, data: mujoco.MjData) -> Float[np.ndarray, "points 3"]:
    """The corners of boxes around all geoms that are drawn, m; planes have no end."""
    hidden = (model.geom_group >= _HIDDEN_GROUP) | (model.geom_rgba[:, 3] == 0.0)
    geoms = np.flatnonzero(~hidden & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE.value))
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3)
    inside = model.geom_aabb[geoms, None, :3] + signs * model.geom_aabb[geoms, None, 3:]
    turned = np.einsum("gij,gkj->gki", data.geom_xmat[geoms].reshape(-1, 3, 3), inside)
    return (data.geom_xpos[geoms, None] + turned).reshape(-1, 3)


def _scene(model: mujoco.MjModel, panel: _Panel, distance: float) -> mujoco.MjvScene:
    camera = mujoco.MjvCamera()
    camera.lookat[:] = panel.centre
    camera.distance = distance
    camera.azimuth, camera.elevation = panel.view
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + len(panel.numbers) + 100)
    kinds = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, panel.data, mujoco.MjvOption(), None, camera, kinds, scene)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        scene.flags[flag] = 0
    add_background(scene)
    for number, tail, tip in zip(panel.numbers, panel.tails, panel.tips, strict=True):
        add_arrow(scene, tail, tip, _ARROW_WIDTH, to_rgba(CONTACT_COLOURS[number % len(CONTACT_COLOURS)]))
    return scene


def _view(pushes: Float[np.ndarray, "arrows 3"]) -> tuple[float, float]:
    """Azimuth and elevation (degrees) of a view from above in which arrows are seen neither end on nor behind."""
    azimuths, elevations = np.meshgrid(np.arange(0.0, 360.0, 15.0), np.arange(-55.0, -14.0, 5.0), indexing="ij")
    a, e = np.radians(azimuths), np.radians(elevations)
    towards_camera = -np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    # Each arrow stands on the object's side that it pushes.
    outward = -pushes / np.linalg.norm(pushes, axis=-1, keepdims=True)
    cosine = towards_camera @ outward.T
    seen = (1.0 - np.clip(-cosine, 0.0, 1.0) ** 2) * np.sqrt(1.0 - np.clip(cosine, -1.0, 1.0) ** 2)
    # Also the worst one counts: views along one of four arrows would win by the three others.
    score = seen.mean(-1) + seen.min(-1) if len(pushes) else -((elevations + 35.0) ** 2)
    best = np.unravel_index(np.argmax(score), score.shape)
    return float(azimuths[best]), float(elevations[best])


def add_arrow(
    scene: mujoco.MjvScene, tail: np.ndarray, tip: np.ndarray, width: float, colour: tuple[float, ...]
) -> None:
    """An arrow from tail to tip (3,), m, world frame.

    Args:
        scene: To which it is added.
        tail: Where it begins.
        tip: Where it ends.
        width: Of its shaft, m.
        colour: RGBA.
    """
    kind = mujoco.mjtGeom.mjGEOM_ARROW
    geom = _add_geom(scene, kind, colour)
    # The renderer draws an arrow half as long as its geom says.
    mujoco.mjv_connector(geom, kind, width, tail, 2.0 * tip - tail)
    geom.emission = 0.15


def add_background(scene: mujoco.MjvScene) -> None:
    """A white wall behind everything: without a sky in the model the background is black."""
    eye = scene.camera[0]
    geom = _add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, (1.0, 1.0, 1.0, 1.0))
    far = 0.9 * eye.frustum_far
    forward, up = np.array(eye.forward, float), np.array(eye.up, float)
    geom.pos[:] = np.array(eye.pos) + far * forward
    geom.mat[:] = np.stack([np.cross(up, forward), up, forward], axis=-1)
    geom.size[:] = (far, far, 1e-3 * far)
    geom.emission = 1.0


def _add_geom(scene: mujoco.MjvScene, kind: mujoco.mjtGeom, colour: tuple[float, ...]) -> mujoco.MjvGeom:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(colour, np.float32))
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1
    return geom


def _compose(
    pictures: list[UInt8[np.ndarray, "height width 3"]], titles: Sequence[str], newtons_per_mm: float
) -> Figure:
    columns = min(len(pictures), 2)
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(_INCHES * columns, (_INCHES + 0.3) * rows + 0.3), layout="constrained", dpi=150)
    for axes, picture, title in zip(figure.subplots(rows, columns, squeeze=False).flat, pictures, titles, strict=False):
        axes.imshow(picture)
        axes.set_title(title, fontsize=9)
    for axes in figure.axes:
        axes.set_axis_off()
    if np.isfinite(newtons_per_mm):
        figure.supxlabel(f"arrows: forces of the fingers on the object, 1 mm = {newtons_per_mm:.2g} N", fontsize=8)
    return figure
