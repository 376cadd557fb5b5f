"""Formats that are known by name and not read: nobody has a file of them to hold a reader against."""

from jaxgrasp.files.content import Content

NAMES = {
    "dexnet": "Dex-Net",
    "springgrasp": "SpringGrasp",
    "frogger": "FRoGGeR",
    "lightning": "Lightning Grasp",
}
"""What the formats are called."""
_SPRINGGRASP = ("contact_", "target_", "wrist_", "compliance_", "joint_angle_")


def unsupported(content: Content) -> str | None:
    """Which of these formats a file is of, as far as its content tells."""
    names = list(content.table)
    if content.kind == "hdf5" and any(name.startswith("objects/") for name in names):
        return "dexnet"
    if content.kind == "array" and content.path.name.startswith(_SPRINGGRASP):
        return "springgrasp"
    if content.kind in ("objects", "torch") and {"q", "object_pose", "contact_pos"} <= set(names):
        return "lightning"
    if content.kind == "objects" and {"q_star", "qstar", "q*"} & set(names):
        return "frogger"
    return None
