"""Many candidates scored, sorted and written."""

from jaxgrasp.ranking.rank import Ranking, RankingInterrupted, rank
from jaxgrasp.ranking.table import TABLE_ENDINGS, ranking_table, write_table

__all__ = [
    "TABLE_ENDINGS",
    "Ranking",
    "RankingInterrupted",
    "rank",
    "ranking_table",
    "write_table",
]
