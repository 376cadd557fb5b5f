"""Section V-A: a hand that holds a ball at rest is pushed from six sides, with tightening forces and without.

As in the paper: no gravity, at most 2 N a finger, lambda of (21) for the six unit forces, f_0 of (22) at 0.75 lambda,
six pushes of 0.75 lambda for 0.1 s, and the optimisation-based control. The weight w of the object's motion, against
contact forces and posture, is 0.1 here; `python -m benchmarks.pushes` has it from 0.05 to 10.

Run: python examples/04_push_at_rest.py
"""

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import Progress

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.simulation import ComputedTorque, ForceOptimization, Push, Run, Simulator, torque_hand  # noqa: E402
from jaxgrasp.viewer import figure_of_pushes, write_figure  # noqa: E402
from jaxgrasp.viewer.movie import write_movie  # noqa: E402

WEIGHT, SHARE = 0.1, 0.75
BEGIN, SECONDS = 0.1, 0.4
NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")

# Four fingers around a ball of 5 cm and 0.1 kg.
sim = Simulator.from_spec(torque_hand("sphere", friction=0.8, gravity=False), max_force=2.0)
grasp = sim.grasps(sim.around[None])
unit = jg.DisturbanceSet.forces(1.0)
largest = jg.largest_disturbance(grasp.contacts, unit)
strength = SHARE * float(largest.margin[0])
print(f"lambda = {largest.margin[0]:.3f} N; each push is {SHARE} lambda = {strength:.3f} N for 0.1 s")


def tightening(share: float) -> np.ndarray:
    """f_0 of (22) at a share of lambda."""
    return np.asarray(jg.least_effort(grasp.contacts, unit, share * largest.margin).forces[0])


def run(forces: list[np.ndarray], controller) -> list[Run]:
    """All six pushes for each of the forces, all at once."""
    lanes, directions = 6 * len(forces), np.stack([sign * axis for axis in np.eye(6)[:3] for sign in (1, -1)])
    push = Push(wrench=np.tile(strength * directions, (len(forces), 1)), begin=BEGIN)
    with Progress(transient=True) as bar:
        task = bar.add_task(f"simulating {lanes} pushes", total=round(1e3 * SECONDS))
        seen = lambda step: bar.update(task, completed=step)  # noqa: E731
        start = np.tile(sim.around, (lanes, 1))
        course = sim.run(start, np.repeat(forces, 6, 0), controller, push, SECONDS, progress=seen)
    return [course.lanes(slice(6 * k, 6 * k + 6)) for k in range(len(forces))]


optimisation = ForceOptimization(weight=jnp.full(12, WEIGHT), friction=jnp.full(12, 0.8))
# The paper's baseline: half a newton of every finger, whatever may come.
names = (f"w = {WEIGHT}, f_0 at {SHARE} lambda", f"w = {WEIGHT}, 0.5 N a finger")
printed = dict(zip(names, run([tightening(SHARE), np.tile([0.0, 0.0, -0.5], (4, 1))], optimisation), strict=True))
# The computed-torque law asks for a wrench that rises to 1.08 of the push, and cannot share it out anew.
beside = dict(zip((0.75, 0.8), run([tightening(0.75), tightening(0.8)], ComputedTorque()), strict=True))

told = {f"optimisation, {name}": part for name, part in printed.items()}
told |= {f"computed torque, f_0 at {share} lambda": part for share, part in beside.items()}
for name, part in told.items():
    away, angle = part.error
    held = f"held {int((~part.lost).sum())} of 6, moved {1e3 * part.peak.max():6.2f} mm"
    end = f"in the end {1e3 * away[-1].max():7.3f} mm and {np.degrees(angle[-1].max()):6.3f} degrees off"
    slip, loss = 1e3 * part.worst_slip().max(), 1e3 * part.longest_loss().max()
    print(f"{name:40s} {held}, {end}, slip {slip:6.3f} mm, contact lost for {loss:3.0f} ms")

write_figure(figure_of_pushes(printed, NAMES), "push_at_rest.png")
panels = [(f"{name}, pushed along +z", part, 4) for name, part in printed.items()]
write_movie("push_at_rest.gif", sim.hand.model, panels, begin=0.08, end=0.34, slower=10)
print("written: push_at_rest.gif", "written: push_at_rest.png", sep="\n")
