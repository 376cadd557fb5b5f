"""Rankings of any number of candidates: part by part, in bounded memory."""

from jaxgrasp.ranking.streams.on_ray import rank_dataset
from jaxgrasp.ranking.streams.tables import TableRanker, rank_batches

__all__ = ["TableRanker", "rank_batches", "rank_dataset"]
