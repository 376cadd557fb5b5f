"""Rank a batch of grasps by the largest disturbance that they resist, and write the table.

Run: python examples/01_rank_a_batch.py
"""

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

from jaxgrasp.candidates import sample_grasps  # noqa: E402
from jaxgrasp.disturbance import DisturbanceSet  # noqa: E402
from jaxgrasp.ranking import rank, write_table  # noqa: E402
from jaxgrasp.solvers.status import Status  # noqa: E402

# 2,000 grasps with four contacts on a rounded box of 0.25 kg; read_candidates(["grasps.npz"]) reads your own.
grasps = sample_grasps(2_000, friction=0.5, max_force=8.0)

# A push of 1 N in any direction at the centre of mass, with 0.01 N m about any axis; lambda says how many times that.
pushes = DisturbanceSet.ball(force=1.0) + DisturbanceSet.ball(force=0.0, torque=0.01)
ranking = rank(grasps, pushes, gravity=9.81, top=3)

for name, count in zip(*np.unique(ranking.status, return_counts=True), strict=True):
    print(f"{Status(int(name)).name}: {count}")
print(f"{(ranking.margin > 1e-6).mean():.0%} bear the weight and resist some push in every direction")

for place, row in enumerate(ranking.order[:3]):
    strongest = jnp.linalg.norm(ranking.object_forces[place], axis=-1).max()
    print(
        f"#{place + 1}: grasp {row}, lambda between {ranking.margin[row]:.6f} and {ranking.upper_bound[row]:.6f}; "
        f"three quarters of that take {strongest:.2f} N from the strongest finger"
    )

write_table(ranking, "ranked_batch.csv")
print("written: ranked_batch.csv")
