"""Many candidates scored, sorted and written."""

from jaxgrasp.ranking.comparison import Comparison, Prediction, compare
from jaxgrasp.ranking.rank import Ranking, RankingInterrupted, rank
from jaxgrasp.ranking.scores import check_metrics, score
from jaxgrasp.ranking.table import TABLE_ENDINGS, ranking_table, write_table

__all__ = [
    "TABLE_ENDINGS",
    "Comparison",
    "Prediction",
    "Ranking",
    "RankingInterrupted",
    "check_metrics",
    "compare",
    "rank",
    "ranking_table",
    "score",
    "write_table",
]
