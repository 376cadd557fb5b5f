"""Many candidate grasps with the same number of contacts, as NumPy columns."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """N candidate grasps with n_c contacts each, in NumPy, so that a million of them wait outside the device.

    Exactly one of `outward_normals` and `frames` is there. Nothing is checked but shapes: a NaN position or a negative
    friction is the affair of that candidate alone and comes out as its status.
    """

    positions: Float[np.ndarray, "batch contacts 3"]
    """Contact positions in the object frame, about the centre of mass, m."""

    outward_normals: Float[np.ndarray, "batch contacts 3"] | None = None
    """Outward normals of the object in its frame."""

    frames: Float[np.ndarray, "batch contacts 3 3"] | None = None
    """Contact frames, columns t1, t2 and the outward normal in the object frame."""

    friction: Float[np.ndarray, "batch contacts"]
    """Coulomb's friction coefficients."""

    max_force: Float[np.ndarray, "batch contacts"]
    """Largest normal forces, N."""

    active: Bool[np.ndarray, "batch contacts"]
    """False where a contact is absent."""

    torsional_friction: Float[np.ndarray, "batch contacts"] | None = None
    """Torsional coefficients, m, 0 for hard contacts; None where all are hard."""

    mass: Float[np.ndarray, " batch"]
    """Masses of the object, kg; NaN where unknown."""

    hand: dict[str, np.ndarray] = field(default_factory=dict)
    """What candidates of a hand have beside: `required_wrench`, N and N m; the fields of `Actuation`; and
    `idle_controls` and `controls_per_effort`, commands of its actuators. Arrays with a leading axis of N, by name."""

    columns: dict[str, np.ndarray] = field(default_factory=dict)
    """What travels along into the table: arrays with a leading axis of N, by name."""

    sources: tuple[str, ...]
    """Names of the files (or of the sampler) that the candidates came from."""

    source: Int[np.ndarray, " batch"]
    """Which of `sources` each candidate came from."""

    index: Int[np.ndarray, " batch"]
    """Row of each candidate within its source."""

    def __len__(self) -> int:
        """Returns the number of candidates N."""
        return self.positions.shape[0]

    @property
    def num_contacts(self) -> int:
        """The number of contacts n_c, absent ones included."""
        return self.positions.shape[1]

    @property
    def normals(self) -> Float[np.ndarray, "batch contacts 3"]:
        """The outward normals as they were given: `outward_normals`, or the third column of `frames`."""
        if self.outward_normals is not None:
            return self.outward_normals
        assert self.frames is not None
        return self.frames[..., 2]

    def take(self, rows: slice | Int[np.ndarray, " rows"]) -> "Candidates":
        """Returns some of the candidates: a slice gives views, an array of rows gives copies in that order."""

        def pick(column: np.ndarray | None) -> np.ndarray | None:
            return None if column is None else column[rows]

        return Candidates(
            positions=self.positions[rows],
            outward_normals=pick(self.outward_normals),
            frames=pick(self.frames),
            friction=self.friction[rows],
            max_force=self.max_force[rows],
            active=self.active[rows],
            torsional_friction=pick(self.torsional_friction),
            mass=self.mass[rows],
            hand={name: column[rows] for name, column in self.hand.items()},
            columns={name: column[rows] for name, column in self.columns.items()},
            sources=self.sources,
            source=self.source[rows],
            index=self.index[rows],
        )


def concatenate(parts: Sequence[Candidates]) -> Candidates:
    """Puts candidates of several sources one after the other.

    Sources with fewer contacts are padded with absent ones; contacts of those without torsional friction are hard. A
    travelling column that a source lacks is filled with NaN (numbers and booleans become float64) or with empty
    strings.

    Args:
        parts: Candidates that all give normals or all give frames.

    Returns:
        All of them in one.

    Raises:
        ValueError: Some give normals and others frames, or a travelling column differs in its trailing shape or is text
            in one and numbers in another.
    """
    if len(parts) == 1:
        return parts[0]
    if len({part.frames is None for part in parts}) > 1:
        raise ValueError("some sources give outward_normals and others frames; wanted the same for all")
    contacts = max(part.num_contacts for part in parts)

    def join(values: Sequence[np.ndarray], padding: np.ndarray | float) -> np.ndarray:
        return np.concatenate([_padded(value, contacts, padding) for value in values])

    # Absent contacts still get a sound frame: no arithmetic on them can then yield a NaN.
    normals = [part.outward_normals for part in parts if part.outward_normals is not None]
    frames = [part.frames for part in parts if part.frames is not None]
    hard = all(part.torsional_friction is None for part in parts)
    torsional = [
        np.zeros(part.friction.shape) if part.torsional_friction is None else part.torsional_friction for part in parts
    ]
    offsets = np.cumsum([0] + [len(part.sources) for part in parts])
    names = list(dict.fromkeys(name for part in parts for name in part.columns))
    return Candidates(
        positions=join([part.positions for part in parts], 0.0),
        outward_normals=join(normals, np.array([0.0, 0.0, 1.0])) if normals else None,
        frames=join(frames, np.eye(3)) if frames else None,
        friction=join([part.friction for part in parts], 1.0),
        max_force=join([part.max_force for part in parts], 1.0),
        active=join([part.active for part in parts], False),
        torsional_friction=None if hard else join(torsional, 0.0),
        mass=np.concatenate([part.mass for part in parts]),
        hand={name: np.concatenate([part.hand[name] for part in parts]) for name in parts[0].hand},
        columns={name: _joined_column(name, parts) for name in names},
        sources=tuple(source for part in parts for source in part.sources),
        source=np.concatenate([part.source + offset for part, offset in zip(parts, offsets, strict=False)]),
        index=np.concatenate([part.index for part in parts]),
    )


def _padded(value: np.ndarray, contacts: int, padding: np.ndarray | float) -> np.ndarray:
    missing = contacts - value.shape[1]
    if missing == 0:
        return value
    shape = (value.shape[0], missing, *value.shape[2:])
    return np.concatenate([value, np.broadcast_to(padding, shape).astype(value.dtype)], axis=1)


def _joined_column(name: str, parts: Sequence[Candidates]) -> np.ndarray:
    present = [part.columns[name] for part in parts if name in part.columns]
    first = present[0]
    text = first.dtype.kind == "U"
    for column in present:
        if column.shape[1:] != first.shape[1:] or (column.dtype.kind == "U") != text:
            raise ValueError(
                f"column {name}: got {column.dtype} {column.shape[1:]} beside {first.dtype} {first.shape[1:]} in "
                "another source; wanted the same kind and trailing shape in all"
            )
    if len(present) == len(parts):
        return np.concatenate(present)
    filler = np.array("") if text else np.array(np.nan)
    return np.concatenate(
        [
            part.columns[name] if name in part.columns else np.broadcast_to(filler, (len(part), *first.shape[1:]))
            for part in parts
        ]
    )
