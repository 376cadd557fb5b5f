"""From a triangle mesh to grasps that are synthesised on it, ranked, and drawn.

Run: python examples/03_mesh_to_grasp.py
"""

import jax
import numpy as np
from matplotlib.figure import Figure

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.candidates import read_candidates  # noqa: E402
from jaxgrasp.geometry import Mesh, sample_surface  # noqa: E402
from jaxgrasp.ranking import rank  # noqa: E402
from jaxgrasp.synthesis import synthesize  # noqa: E402
from jaxgrasp.viewer import common_scale, draw_grasp, write_figure  # noqa: E402

# A bottle of 13 cm, by its outline (radius, height), turned about z into triangles; any .stl, .obj or .ply does.
OUTLINE = np.array([(0.0, 0.0), (0.028, 0.0), (0.032, 0.004), (0.032, 0.07), (0.014, 0.1), (0.014, 0.128), (0.0, 0.13)])
SIDES = 32
angles = 2 * np.pi * np.arange(SIDES) / SIDES
turned = np.stack([np.cos(angles), np.sin(angles), np.ones(SIDES)], -1)
corners = (turned[None] * OUTLINE[:, None, [0, 0, 1]]).reshape(-1, 3)
with open("bottle.obj", "w") as file:
    for x, y, z in corners:
        file.write(f"v {x:.6f} {y:.6f} {z:.6f}\n")
    for ring in range(len(OUTLINE) - 1):
        for side in range(SIDES):
            a, b = ring * SIDES + side + 1, ring * SIDES + (side + 1) % SIDES + 1
            file.write(f"f {a} {b} {b + SIDES}\nf {a} {b + SIDES} {a + SIDES}\n")

mesh = Mesh.from_file("bottle.obj")
shape = mesh.to_grid(nodes=40_000)
points = np.asarray(sample_surface(shape, jax.random.key(1), 1500))
off = 1e3 * np.median(mesh.deviation(points))
print(f"{len(mesh.faces)} triangles, {1e6 * mesh.volume:.0f} ml; surface of the grid {off:.3f} mm off in the median")

# Fingers that are not farther apart than 10 cm, against a push of 1 N in any direction with 0.02 N m about any axis.
pushes = jg.DisturbanceSet.ball(force=1.0, torque=0.02)
found = synthesize(
    shape,
    4,
    jax.random.key(0),
    disturbances=pushes,
    friction=0.6,
    max_force=10.0,
    starts=128,
    steps=100,
    spacing=0.015,
    span=0.1,
    center_of_mass=mesh.centroid,
)
for name, margin in (("random starts", found.first_margin), ("synthesised", found.margin)):
    print(f"{name}: {(margin > 1e-4).mean():.0%} positive, median {np.median(margin):.2f}, best {margin.max():.2f}")

fields = {"positions": found.positions, "outward_normals": found.outward_normals, "mass": 0.3}
np.savez("bottle_grasps.npz", friction=0.6, max_force=10.0, **fields)
ranking = rank(read_candidates(["bottle_grasps.npz"]), pushes, gravity=9.81, top=0)
print("the best two while bearing 0.3 kg:", np.round(ranking.margin[ranking.order[:2]], 2))

figure = Figure(figsize=(10.0, 5.0), layout="constrained", dpi=150)
best = ranking.order[:2]
scale = common_scale(found.positions[best], found.forces[best])
for place, row in enumerate(best):
    axes = figure.add_subplot(1, 2, place + 1, projection="3d", proj_type="ortho")
    grasp = (found.positions[row], found.outward_normals[row], found.forces[row])
    draw_grasp(axes, *grasp, friction=np.full(4, 0.6), surface=points - mesh.centroid, scale=scale)
    axes.set_title(f"#{place + 1}: $\\lambda = {found.margin[row]:.2f}$; 1 mm = {scale:.2g} N", fontsize=10, y=1.05)
write_figure(figure, "mesh_to_grasp.png")
print("written: mesh_to_grasp.png")
