"""Figures: that they can be made of any ranking, and that what they draw stands where the numbers say."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3D

from jaxgrasp.candidates import Candidates, sample_grasps
from jaxgrasp.ranking import Ranking
from jaxgrasp.solvers.status import Status
from jaxgrasp.viewer import draw_grasp, figure_of_ranking, write_figure


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
    assert "[N]" in text and "1 mm" in text


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
