"""How deep MuJoCo's contacts are pressed in at rest: what a servo has to go beyond the surface.

A contact whose surfaces are r deep in each other bears f = k d(r)^2 r / ((1 - d(r)) A) at rest, with A the sum of the
two bodies' inverse weights, the impedance d by solimp, and k by solref: k = 1 / (d_max t zeta)^2, or -solref / d_max^2.
"""

import mujoco
import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.hands.bodies import bodies_below
from jaxgrasp.hands.contact_parameters import ContactParameters, hand_object_pairs
from jaxgrasp.hands.hand_object import HandObject

# m, the deepest that is asked for, and how finely.
_DEEPEST, _STEPS = 0.02, 4001
# MuJoCo's bounds of an impedance.
_LEAST, _MOST = 1e-4, 0.9999


def depths(
    hand: HandObject, links: Int[np.ndarray, "n contacts"], forces: Float[np.ndarray, " forces"]
) -> Float[np.ndarray, "n contacts forces"]:
    """Depths, m, at which contacts of links of the hand bear normal forces; the mean over what of them can touch.

    Args:
        hand: The hand and the object.
        links: Bodies of the hand.
        forces: N, rising from 0.
    """
    model, of_object = hand.model, bodies_below(hand.model, hand.object_body)
    pairs = hand_object_pairs(model, hand.bodies, of_object)
    table = np.zeros((model.nbody, len(forces)))
    for link in np.unique(links):
        own = [(parameters, o) for (g, o), parameters in pairs.items() if model.geom_bodyid[g] == link]
        curves = {}
        for parameters, other in own:
            key = (*parameters.solref, *parameters.solimp, int(model.geom_bodyid[other]))
            if key not in curves:
                curves[key] = _curve(model, parameters, int(link), int(model.geom_bodyid[other]), forces)
        table[link] = np.mean(list(curves.values()), 0) if curves else 0
    return table[links]


def _curve(
    model: mujoco.MjModel, parameters: ContactParameters, link: int, other: int, forces: np.ndarray
) -> np.ndarray:
    low, high, width, middle, power = parameters.solimp
    low, high = (min(max(end, _LEAST), _MOST) for end in (low, high))
    depth = np.linspace(0, _DEEPEST, _STEPS)
    x = (depth / max(width, 1e-15)).clip(0, 1)
    middle = min(max(middle, _LEAST), _MOST)
    rising = np.where(x < middle, x**power / middle ** (power - 1), 1 - (1 - x) ** power / (1 - middle) ** (power - 1))
    impedance = low + (high - low) * rising
    time, ratio = parameters.solref
    if time > 0:
        if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE):
            time = max(time, 2 * model.opt.timestep)
        stiffness = 1 / (high * time * ratio) ** 2
    else:
        stiffness = -time / high**2
    yielding = max(float(model.body_invweight0[[link, other], 0].sum()), 1e-12)
    return np.interp(forces, stiffness * impedance**2 * depth / ((1 - impedance) * yielding), depth)
