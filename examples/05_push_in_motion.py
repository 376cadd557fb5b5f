"""Section V-B: a hand carries a ball 2 cm along -y under gravity and is pushed along +x on the way.

Run: python examples/05_push_in_motion.py
"""

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import Progress

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.simulation import ComputedTorque, ForceOptimization, Path, Push, Simulator, torque_hand  # noqa: E402
from jaxgrasp.viewer import figure_of_motions, write_figure  # noqa: E402
from jaxgrasp.viewer.movie import write_movie  # noqa: E402

SECONDS = 4.0
NAMES = ("pushed", "not pushed")

sim = Simulator.from_spec(torque_hand("sphere", friction=0.8), max_force=2.0)
grasp = sim.grasps(sim.around[None])
unit, weight = jg.DisturbanceSet.forces(1.0), grasp.required_wrench
largest = jg.largest_disturbance(grasp.contacts, unit, required_wrench=weight)
hold = jg.least_effort(grasp.contacts, unit, 0.85 * largest.margin, required_wrench=weight)
force = 0.75 * float(largest.margin[0])
print(f"required wrench: {np.asarray(weight[0]).round(3)}, the ball's weight; lambda = {largest.margin[0]:.3f} N")
print(f"a push of 0.75 lambda = {force:.3f} N for 0.1 s at 2 s; f_0 by (22) at 0.85 lambda")

# Two lanes: pushed and not. From 1 to 3 s the ball is to go 2 cm along -y.
start, tightening = np.tile(sim.around, (2, 1)), np.tile(hold.forces, (2, 1, 1))
push = Push(wrench=np.array([[force, 0, 0, 0, 0, 0], np.zeros(6)]), begin=2.0)
goal = np.tile([0.0, -0.02, 0.0, 0.0, 0.0, 0.0], (2, 1))
path = Path.to(goal, np.full(2, 1.0), np.full(2, 3.0))
optimisation = ForceOptimization(weight=jnp.full(2, 0.1), friction=jnp.full(2, 0.8))

runs = {}
for name, controller in (("computed torque", ComputedTorque()), ("optimisation, w = 0.1", optimisation)):
    # Anew from where the ball is 0.12 s after it was found more than 0.3 mm off, once the push is over.
    for variant, replan in (("path kept", None), ("path begun anew", (3e-4, 0.12))):
        with Progress(transient=True) as bar:
            task = bar.add_task(f"{name}, {variant}", total=round(1e3 * SECONDS))
            seen = lambda step, bar=bar, task=task: bar.update(task, completed=step)  # noqa: E731
            run = sim.run(start, tightening, controller, push, SECONDS, path=path, replan=replan, progress=seen)
        runs[f"{name}, {variant}"] = run
        off = np.linalg.norm(run.position[-1] - goal[:, :3], axis=-1)
        far = np.linalg.norm(run.position - run.position[:, 1:], axis=-1)[:, 0].max()
        print(
            f"{name + ', ' + variant:40s} off its target in the end: pushed {1e3 * off[0]:.4f} mm, not pushed "
            f"{1e3 * off[1]:.4f} mm; the push moved it {1e3 * far:.2f} mm; slip {1e3 * run.worst_slip()[0]:.3f} mm, "
            f"contact lost for {1e3 * run.longest_loss()[0]:.0f} ms"
        )

write_figure(figure_of_motions(runs, NAMES), "push_in_motion.png")
panels = [(name, run, 0) for name, run in runs.items()]
write_movie("push_in_motion.gif", sim.hand.model, panels[::2], begin=0.8, end=3.4, slower=2)
print("written: push_in_motion.gif")
print("written: push_in_motion.png")
