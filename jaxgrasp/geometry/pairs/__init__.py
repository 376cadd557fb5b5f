"""Where two geoms touch or come near: points, normals and distances, lane by lane, as C MuJoCo reports them."""

from jaxgrasp.geometry.pairs.geom import KINDS, Geom, Hull, Touch
from jaxgrasp.geometry.pairs.table import slots, touch

__all__ = ["KINDS", "Geom", "Hull", "Touch", "slots", "touch"]
