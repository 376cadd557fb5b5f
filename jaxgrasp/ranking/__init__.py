"""Many candidates scored, sorted and written."""

from jaxgrasp.ranking.comparison import MetricComparison, Prediction, compare_metrics
from jaxgrasp.ranking.rank import Ranking, RankingInterrupted, rank
from jaxgrasp.ranking.scores import check_metrics, score
from jaxgrasp.ranking.streams import TableRanker, rank_batches, rank_dataset
from jaxgrasp.ranking.table import TABLE_ENDINGS, ranking_table, write_table
from jaxgrasp.ranking.uncertain import Uncertain, uncertain_scores

__all__ = [
    "TABLE_ENDINGS",
    "MetricComparison",
    "Prediction",
    "Ranking",
    "RankingInterrupted",
    "TableRanker",
    "Uncertain",
    "check_metrics",
    "compare_metrics",
    "rank",
    "rank_batches",
    "rank_dataset",
    "ranking_table",
    "score",
    "uncertain_scores",
    "write_table",
]
