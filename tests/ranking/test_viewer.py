"""Figures: that they can be made of any ranking, and that what they draw stands where the numbers say."""

import re

import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from mpl_toolkits.mplot3d.art3d import Line3D

from jaxgrasp.candidates import Candidates, sample_grasps
from jaxgrasp.hands import HandObject, sample_configurations, scenes
from jaxgrasp.ranking import Ranking
from jaxgrasp.solvers.status import Status
from jaxgrasp.viewer import draw_grasp, figure_of_ranking, write_figure
from jaxgrasp.viewer.solids import held_by, triangles_of


def ranking_of(margin, status=None, top=3) -> Ranking:
    """A made-up ranking: every finger pushes straight with 2 N."""
    margin = np.asarray(margin, dtype=float)
    candidates: Candidates = sample_grasps(len(margin))
    status = np.full(len(margin), int(Status.SOLVED)) if status is None else np.asarray(status)
    order = np.argsort(-margin)
    forces = -2.0 * candidates.normals[order[:top]]
    return Ranking(
        candidates=candidates,
        margin=margin,
        upper_bound=margin,
        status=status,
        order=order,
        share=0.75,
        forces=forces,
        object_forces=forces,
        effort=np.where(np.isnan(margin[order[:top]]), np.nan, 8.0),
        tightening_status=np.zeros(len(forces), dtype=int),
        controls=np.zeros((len(forces), 0)),
    )


def text_of(figure: Figure) -> str:
    return " ".join(axes.get_title() + axes.get_xlabel() for axes in figure.findobj() if hasattr(axes, "get_xlabel"))


@pytest.mark.parametrize(
    ("ranking", "panels"),
    [
        (ranking_of([3.0, 1.0, 2.0, 0.0, 0.5]), 3),
        (ranking_of([3.0], top=1), 1),
        (ranking_of(np.zeros(5)), 3),
        (ranking_of([1.0, 2.0], top=0), 0),
        (ranking_of(np.full(4, np.nan), [Status.INFEASIBLE] * 2 + [Status.INVALID_INPUT] * 2), 0),
        (ranking_of([np.inf, np.inf, 1.0], [Status.UNBOUNDED, Status.UNBOUNDED, Status.SOLVED]), 3),
    ],
)
def test_any_ranking_has_a_figure(ranking, panels, tmp_path):
    figure = figure_of_ranking(ranking, loaded=True)
    assert len(figure.findobj(lambda artist: hasattr(artist, "get_zlim"))) == panels
    write_figure(figure, tmp_path / "figure.png")


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_ending_says_the_format(ending, tmp_path):
    path = tmp_path / f"figure.{ending}"
    write_figure(figure_of_ranking(ranking_of([3.0], top=1)), path)
    starts = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}
    assert path.read_bytes().startswith(starts[ending])
    assert list(tmp_path.iterdir()) == [path]


def test_labels_have_units():
    text = text_of(figure_of_ranking(ranking_of([3.0, 1.0]), unit="N"))
    assert "[N]" in text and "\\lambda = 3$ N" in text


def test_all_panels_have_one_scale_of_arrows():
    ranking = ranking_of([3.0, 2.0, 1.0])
    ranking.object_forces[1] *= 0.1
    figure = figure_of_ranking(ranking)
    told = [text.get_text() for legend in figure.findobj(Legend) for text in legend.get_texts() if "1 mm" in str(text)]
    (scale,) = re.findall(r"1 mm = ([\d.]+) N", told[0])
    for place, axes in enumerate(figure.findobj(lambda artist: hasattr(artist, "get_zlim"))):
        thick = [line for line in axes.lines if isinstance(line, Line3D) and line.get_linewidth() == 2.0]
        places = 1e3 * ranking.candidates.positions[ranking.order[place]]
        tails = [np.array([coordinate[0] for coordinate in line.get_data_3d()]) for line in thick]
        lengths = np.linalg.norm(tails - places, axis=-1)
        np.testing.assert_allclose(lengths, (0.2 if place == 1 else 2.0) / float(scale), rtol=1e-6)


def test_a_force_ends_at_its_contact_and_has_the_scale():
    figure = Figure()
    axes = figure.add_subplot(projection="3d")
    position, force = np.array([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]]), np.array([[-4.0, 0.0, 1.0], [np.nan] * 3])
    normal = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    scale = draw_grasp(axes, position, normal, force, friction=np.full(2, 0.5))
    thick = [line for line in axes.lines if isinstance(line, Line3D) and line.get_linewidth() == 2.0]
    assert len(thick) == 1
    tail = np.array([coordinate[0] for coordinate in thick[0].get_data_3d()])
    np.testing.assert_allclose(tail, 1e3 * position[0] - force[0] / scale)
    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    np.testing.assert_allclose(limits, np.broadcast_to(limits[0], limits.shape))


def test_absent_contacts_are_not_drawn():
    figure = Figure()
    axes = figure.add_subplot(projection="3d")
    position = np.array([[0.03, 0.0, 0.0], [np.nan] * 3, [0.0, 0.03, 0.0]])
    normal = np.array([[1.0, 0.0, 0.0], [0.0] * 3, [0.0, 1.0, 0.0]])
    active = np.array([True, False, True])
    draw_grasp(axes, position, normal, -normal, friction=np.full(3, 0.5), active=active)
    assert [text.get_text() for text in axes.texts] == ["0", "2"]


BOX, MESH = 'type="box" size="0.1 0.2 0.3"', 'type="mesh" mesh="corner"'
VOLUMES = {
    BOX: 8 * 0.1 * 0.2 * 0.3,
    'size="0.1"': 4 / 3 * np.pi * 0.1**3,
    'type="capsule" size="0.1 0.2"': np.pi * 0.1**2 * (0.4 + 4 / 3 * 0.1),
    'type="cylinder" size="0.1 0.2"': np.pi * 0.1**2 * 0.4,
    'type="ellipsoid" size="0.1 0.2 0.3"': 4 / 3 * np.pi * 0.1 * 0.2 * 0.3,
    MESH: 1 / 6,
    'type="plane" size="1 1 1"': 0.0,
}


@pytest.mark.parametrize("geom", VOLUMES)
def test_surfaces_of_geoms_enclose_their_volumes(geom):
    """From outside the corners go round counterclockwise: signed tetrahedra add up to the volume."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><mesh name="corner" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'
        f"<worldbody><geom {geom}/></worldbody></mujoco>"
    )
    a, b, c = np.moveaxis(triangles_of(model, 0), 1, 0)
    volume = np.einsum("ni,ni->", a, np.cross(b, c)) / 6
    # 24 corners round a circle, which they are inside of.
    assert volume == pytest.approx(VOLUMES[geom], rel=1e-6 if geom in (BOX, MESH) else 0.04)


def test_panels_show_hand_object_and_links_of_contacts():
    hand = HandObject.from_mjcf(scenes.four_fingers(), "object")
    (qpos,) = sample_configurations(hand, 1, seed=3)
    held = held_by(hand, qpos)
    corners = np.concatenate(held.object).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=-1), 0.025, rtol=1e-6)
    contacts = hand.grasps(qpos).contacts
    points, there = np.asarray(contacts.positions), np.asarray(contacts.active)
    # Contacts are on the hand's surface and on the object's.
    for point in points[there]:
        assert min(np.linalg.norm(part - point, axis=-1).min() for part in held.hand) < 0.008
    axes = Figure().add_subplot(projection="3d")
    normals = np.asarray(contacts.frames)[..., 2]
    draw_grasp(axes, points, normals, -normals, friction=np.ones(len(points)), active=there, held=held)
    words = " ".join(text.get_text() for text in axes.texts)
    assert all(name in words for name, active in zip(held.links, there, strict=True) if active)
    assert {hand.model.body(name).id for name in held.links} <= set(hand.bodies.tolist())
