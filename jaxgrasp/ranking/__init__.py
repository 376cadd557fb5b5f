"""Many candidates scored, sorted and written."""

from jaxgrasp.ranking.comparison import MetricComparison, Prediction, compare_metrics
from jaxgrasp.ranking.rank import Ranking, RankingInterrupted, rank
from jaxgrasp.ranking.scores import check_metrics, score
from jaxgrasp.ranking.streams import TableRanker, rank_batches, rank_dataset
from jaxgrasp.ranking.table import TABLE_ENDINGS, ranking_table, write_table
from jaxgrasp.ranking.zero_margins import is_zero, why_zero

__all__ = [
    "TABLE_ENDINGS",
    "MetricComparison",
    "Prediction",
    "Ranking",
    "RankingInterrupted",
    "TableRanker",
    "check_metrics",
    "compare_metrics",
    "is_zero",
    "rank",
    "rank_batches",
    "rank_dataset",
    "ranking_table",
    "score",
    "why_zero",
    "write_table",
]
