"""Figures of grasps and rankings, made with matplotlib and no window.

What renders with MuJoCo, which takes long to import, is in `movie` and `scene`.
"""

from jaxgrasp.viewer.comparison import figure_of_comparison
from jaxgrasp.viewer.grasp import common_scale, draw_grasp
from jaxgrasp.viewer.hand_synthesis import figure_of_hand_synthesis
from jaxgrasp.viewer.ranking import figure_of_ranking, write_figure
from jaxgrasp.viewer.simulation import figure_of_motions, figure_of_pushes
from jaxgrasp.viewer.synthesis import figure_of_synthesis

__all__ = [
    "common_scale",
    "draw_grasp",
    "figure_of_comparison",
    "figure_of_hand_synthesis",
    "figure_of_motions",
    "figure_of_pushes",
    "figure_of_ranking",
    "figure_of_synthesis",
    "write_figure",
]
