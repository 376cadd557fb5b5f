"""Section V-A: a hand that holds a ball at rest is pushed from six sides, with tightening forces and without.

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

BEGIN, SECONDS = 0.1, 0.4
NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
WEIGHTS = (0.05, 0.1, 0.2, 0.5, 1.0, 10.0)

# Four fingers around a ball of 5 cm and 0.1 kg, without gravity; at most 2 N a finger.
sim = Simulator.from_spec(torque_hand("sphere", friction=0.8, gravity=False), max_force=2.0)
grasp = sim.grasps(sim.around[None])
unit = jg.DisturbanceSet.forces(1.0)
largest = jg.largest_disturbance(grasp.contacts, unit)
print(f"lambda = {largest.margin[0]:.3f} N; each push is 0.75 lambda for 0.1 s")
tightening = {
    f"f_0 at {share} lambda": np.asarray(jg.least_effort(grasp.contacts, unit, share * largest.margin).forces[0])
    for share in (0.75, 0.85)
}
# The paper's baseline: half a newton of every finger, whatever may come.
tightening["0.5 N a finger"] = np.tile([0.0, 0.0, -0.5], (4, 1))

directions = np.stack([sign * axis for axis in np.eye(3) for sign in (1, -1)])
pushes = 0.75 * float(largest.margin[0]) * np.concatenate([directions, np.zeros((6, 3))], 1)


def run(forces: list[np.ndarray], controller) -> Run:
    """All six pushes for each of the forces, all at once."""
    lanes = 6 * len(forces)
    push = Push(wrench=np.tile(pushes, (len(forces), 1)), begin=BEGIN)
    with Progress(transient=True) as bar:
        task = bar.add_task(f"simulating {lanes} pushes", total=round(1e3 * SECONDS))
        seen = lambda step: bar.update(task, completed=step)  # noqa: E731
        start = np.tile(sim.around, (lanes, 1))
        return sim.run(start, np.repeat(forces, 6, 0), controller, push, SECONDS, progress=seen)


def tell(name: str, part: Run) -> None:
    """One line of figures: the worst of six pushes."""
    away, angle = part.error
    held = f"held {int((~part.lost).sum())} of 6, moved {1e3 * part.peak.max():7.2f} mm"
    end = f"in the end {1e3 * away[-1].max():7.3f} mm and {np.degrees(angle[-1].max()):.3f} degrees off"
    slip, loss = 1e3 * part.worst_slip().max(), 1e3 * part.longest_loss().max()
    print(f"{name:42s} {held}, {end}, slip {slip:6.3f} mm, contact lost for {loss:3.0f} ms")


shown = {}
course = run(list(tightening.values()), ComputedTorque())
for number, name in enumerate(tightening):
    shown[f"computed torque, {name}"] = part = course.lanes(slice(6 * number, 6 * number + 6))
    tell(f"computed torque, {name}", part)

# The optimisation-based control trades the object's motion, with weight w, against contact forces and posture.
for name, forces in list(tightening.items())[1:]:
    weights = jnp.repeat(jnp.array(WEIGHTS), 6)
    controller = ForceOptimization(weight=weights, friction=jnp.full_like(weights, 0.8))
    course = run([forces] * len(WEIGHTS), controller)
    for number, weight in enumerate(WEIGHTS):
        part = course.lanes(slice(6 * number, 6 * number + 6))
        tell(f"optimisation w = {weight:g}, {name}", part)
        if weight == 0.1:
            shown[f"optimisation, {name}"] = part

write_figure(figure_of_pushes(dict(list(shown.items())[1:]), NAMES), "push_at_rest.png")
panels = [(f"{name}, +z", part, 4) for name, part in list(shown.items())[1:]]
write_movie("push_at_rest.gif", sim.hand.model, panels, begin=0.08, end=0.34, slower=10)
print("written: push_at_rest.gif", "written: push_at_rest.png", sep="\n")
