"""How much the tangents matter: margins (21) as they turn, against exact cones: `python -m benchmarks.tangents`.

Writes tangents.md beside this file; with --quick it prints a sample.
"""

from __future__ import annotations

import argparse
import os
import platform
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import problems  # noqa: E402
from benchmarks.suite.clock import by_turns, say, warn_if_busy  # noqa: E402

GRASPS, QUICK_GRASPS, CONTACTS = 500, 100, 4
EDGES = (4, 6, 8, 12, 16, 32)
TURNS, FEW = 16, 4
LEAST = 0.05
"""N: grasps with a smaller margin with exact cones are left out, of which ratios would tell little."""
SAMPLED = 4
"""Times as many grasps are sampled as are wanted."""
TIMED, ROUNDS = 4096, 60
FORCES = jg.DisturbanceSet.forces(1.0)


def sampled(count: int) -> tuple[jg.Contacts, np.ndarray, int]:
    """Grasps with a margin, their margins by (12) with fixed answers and with free ones (2, count), and of how many."""
    grasps = problems.sample(SAMPLED * count, CONTACTS)
    limits = {"friction": problems.FRICTION, "max_force": problems.MAX_FORCE}
    contacts = jg.Contacts.from_frames(grasps.positions, grasps.frames, **limits)
    fixed = np.asarray(jg.formulation_margin(contacts, FORCES, "12_fixed").margin)
    chosen = np.flatnonzero(fixed > LEAST)[:count]
    assert len(chosen) == count, f"{len(chosen)} of {len(grasps)} grasps have a margin"
    contacts = jax.tree.map(lambda x: x[chosen], contacts)
    free = np.asarray(jg.formulation_margin(contacts, FORCES, "12").margin)
    return contacts, np.stack([fixed[chosen], free]), int(chosen[-1]) + 1


def turned(contacts: jg.Contacts, angles: np.ndarray) -> jg.Contacts:
    """Contacts whose tangents are turned about the outward normals, by angles (*batch, n_c)."""
    cosine, sine, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    turn = np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1], -1).reshape(*angles.shape, 3, 3)
    return jg.Contacts.from_frames(
        contacts.positions, contacts.frames @ turn, friction=contacts.friction, max_force=contacts.max_force
    )


def turned_margins(contacts: jg.Contacts, edges: int, apart: bool) -> np.ndarray:
    """Margins (TURNS, grasps): all tangents turned alike, evenly over an edge's angle, or each contact's at random."""
    angles = np.arange(TURNS)[:, None, None] / TURNS
    if apart:
        angles = np.random.default_rng(24).random((TURNS, *contacts.friction.shape))
    return np.asarray(
        jg.largest_disturbance(turned(contacts, 2 * np.pi / edges * angles), FORCES, cone_edges=edges).margin
    )


def quantiles(ratio: np.ndarray) -> str:
    """Least, quartiles and largest."""
    return " / ".join(f"{value:.3f}" for value in np.quantile(ratio, [0, 0.25, 0.5, 0.75, 1]))


def table(contacts: jg.Contacts, exact: np.ndarray) -> tuple[list[str], list[str]]:
    """Rows of the largest over the least margin, and rows of what is left of the exact cones'."""
    spread, left = [], []
    for edges in EDGES:
        cells = []
        for apart in (False, True):
            margins = turned_margins(contacts, edges, apart)
            held = margins.min(0) > 1e-6
            cells += [quantiles(margins[:, held].max(0) / margins[:, held].min(0)), str((~held).sum())]
            if not apart:
                few = margins[:: TURNS // FEW].max(0)
                shares = [share / exact[0] for share in (margins.min(0), margins[0], few, margins.max(0))]
        spread.append(f"| {edges} | {' | '.join(cells)} |")
        left.append(f"| {edges} | {' | '.join(map(quantiles, shares))} |")
    return spread, left


def costs() -> dict[str, float]:
    """Seconds for the margins of many grasps: eight edges, four turns of eight edges, and more edges."""
    grasps = problems.sample(TIMED, CONTACTS)
    limits = {"friction": problems.FRICTION, "max_force": problems.MAX_FORCE}
    contacts = jg.Contacts.from_frames(grasps.positions, grasps.frames, **limits)
    angles = np.arange(FEW)[:, None, None] * (2 * np.pi / 8 / FEW)

    def margins(edges: int, given: jg.Contacts = contacts):
        def job() -> None:
            jax.block_until_ready(jg.largest_disturbance(given, FORCES, cone_edges=edges).margin)

        return job

    jobs = {
        "8 edges": margins(8),
        "4 turns of 8 edges": margins(8, turned(contacts, angles)),
        "16 edges": margins(16),
        "32 edges": margins(32),
    }
    return {name: timing.seconds for name, timing in by_turns(jobs, ROUNDS).items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_GRASPS} grasps, printed alone")
    quick = parser.parse_args().quick
    load = warn_if_busy()
    contacts, exact, of = sampled(QUICK_GRASPS if quick else GRASPS)
    spread, left = table(contacts, exact)
    seconds = costs()
    first = seconds.pop("8 edges")
    cost = ", ".join(f"{name} {value / first:.1f}" for name, value in seconds.items())
    text = f"""# What the tangents matter

`python -m benchmarks.tangents`, {platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}, load {load:.1f}.

The pyramids of (21) have their edges at angles from the first tangent, on Coulomb's cone: as tangents turn, so do the
pyramids, and the margin changes though the grasp does not. Grasps: {len(exact[0])} random ones of an ellipsoid with
{CONTACTS} contacts, friction {problems.FRICTION}, {problems.MAX_FORCE:g} N a finger, six unit forces: the first of
{of} whose margin with exact cones, (12) with blocking forces, is above {LEAST} N. All figures are
least / quartiles / largest over the grasps.

## The largest over the least margin of {TURNS} turns

**Alike**: the tangents of all contacts turn together, evenly over the angle between edges. **Apart**: each contact's by
an angle of its own, at random. Grasps that lose their margin in some turn are counted in "lost" and in no ratio.

| edges | alike | lost | apart | lost |
|---|---|---|---|---|
{chr(10).join(spread)}

## What is left of the margin with exact cones

Turns alike; the best of {FEW} are {FEW} of the {TURNS}, evenly spaced.

| edges | worst of {TURNS} | as given | best of {FEW} | best of {TURNS} |
|---|---|---|---|---|
{chr(10).join(left)}

(12) with free answers allows {quantiles(exact[1] / exact[0])} of what it allows with blocking forces.

## What it costs

Time for {TIMED:,} grasps in units of one margin with 8 edges, the best of {ROUNDS} rounds by turns:
{cost}.

## Turning tangents

All pyramids lie within Coulomb's cone, so the best margin of several turns is as safe as each of them:

    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    turned = dataclasses.replace(contacts, frames=contacts.frames @ turn)

Turns by 2 pi / n_e give the pyramids anew. A compliance is in contact frames: one that is not alike in both tangents
has to be turned, too.
"""
    if not quick:
        Path(__file__).with_suffix(".md").write_text(text)
    say(text)


if __name__ == "__main__":
    main()
