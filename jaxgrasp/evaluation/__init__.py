"""Grasps of files tried by a named protocol: what became of each, and what is to be said of all."""

from jaxgrasp.evaluation.evaluate import Evaluation, evaluate, film
from jaxgrasp.evaluation.scores import candidates_of_grasps
from jaxgrasp.evaluation.summary import Summary, diversity, summaries, wilson
from jaxgrasp.evaluation.table import TABLE_ENDINGS, evaluation_table, write_evaluation

__all__ = [
    "TABLE_ENDINGS",
    "Evaluation",
    "Summary",
    "candidates_of_grasps",
    "diversity",
    "evaluate",
    "evaluation_table",
    "film",
    "summaries",
    "wilson",
    "write_evaluation",
]
