"""Tightening forces hold a grasp before anything happens; blocking forces answer while a disturbance acts.

Run: python examples/02_tightening_and_blocking_forces.py
"""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.viewer import common_scale, draw_grasp, write_figure  # noqa: E402

# A thumb against three fingers on a ball of 3 cm radius and 0.1 kg.
directions = jnp.array([[-1.0, 0.0, 0.1], [0.8, -0.6, 0.2], [0.8, 0.6, 0.2], [0.9, 0.0, -0.7]])
normals = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
contacts = jg.Contacts.from_normals(0.03 * normals, normals, friction=0.6, max_force=6.0)
weight = jg.required_wrench(0.1, gravity=jnp.array([0.0, 0.0, -9.81]))

# How large may a force along any of the axes become, (21), and which forces hold against three quarters of that, (22)?
pushes = jg.DisturbanceSet.forces(1.0)
largest = jg.largest_disturbance(contacts, pushes, required_wrench=weight)
wanted = 0.75 * largest.margin
tightening = jg.least_effort(contacts, pushes, wanted, required_wrench=weight)
print(f"margin: {largest.margin:.3f} N (at most {largest.upper_bound:.3f} N)")

# What the fingers add while each of the six pushes acts, (15), and what they then exert in all.
wrenches = wanted * jnp.concatenate([jnp.concatenate([jnp.eye(3), -jnp.eye(3)]), jnp.zeros((6, 3))], axis=1)
blocking = jg.blocking_forces(contacts, wrenches)
total = tightening.forces + blocking
pressure = -total[..., 2]
share_of_cone = jnp.linalg.norm(total[..., :2], axis=-1) / (0.6 * pressure)
for name, use, force in zip(("+x", "+y", "+z", "-x", "-y", "-z"), share_of_cone, pressure, strict=True):
    print(f"push along {name}: {use.max():.0%} of the friction cone, {force.max():.2f} N of 6 N at the worst finger")

# The same in a picture: before, and while the push acts that brings a finger nearest to slipping.
worst = int(share_of_cone.max(axis=-1).argmax())
in_object_frame = np.einsum("cij,...cj->...ci", contacts.frames, jnp.stack([tightening.forces, total[worst]]))
figure = Figure(figsize=(10.0, 5.0), layout="constrained", dpi=150)
titles = ("Tightening forces; black: weight", f"With blocking forces; black: push of {wanted:.2f} N")
loads = (np.array([0.0, 0.0, -1.0]), np.asarray(wrenches[worst, :3]))
scale = common_scale([np.asarray(contacts.positions)] * 2, in_object_frame)
for place in range(2):
    axes = figure.add_subplot(1, 2, place + 1, projection="3d", proj_type="ortho")
    draw_grasp(
        axes,
        np.asarray(contacts.positions),
        np.asarray(normals),
        in_object_frame[place],
        friction=np.asarray(contacts.friction),
        load=loads[place],
        scale=scale,
    )
    axes.set_title(f"{titles[place]}\nfingers: 1 mm = {scale:.2g} N", fontsize=10, y=1.05)
write_figure(figure, "tightening_and_blocking_forces.png")
print("written: tightening_and_blocking_forces.png")
