"""What the page says of one grasp, as HTML."""

import html

import numpy as np

from jaxgrasp.solvers.status import Status
from jaxgrasp.viewer.browser.shapes import contact_colour
from jaxgrasp.viewer.browser.what_if import Answer, Reasons

_BOX = "padding:0 0.8em 0.3em;font-size:12px"
_TABLE = "width:100%;font-size:12px;text-align:left;border-collapse:collapse"


def report(name: str, answer: Answer, reasons: Reasons | None, unit: str, share: float) -> str:
    """The margin, the forces and what ends the margin.

    Args:
        name: Of the grasp.
        answer: What was found.
        reasons: What ends its margin; None while that is not known.
        unit: Of the margin.
        share: Of the margin, for which the forces hold.
    """
    lines = [f"<div>{html.escape(name)}</div>", f"<div style='font-size:18px'><b>{_margin(answer, unit)}</b></div>"]
    load = np.linalg.norm(answer.load[:3])
    if load > 0:
        lines.append(f"<div>bears a load of {load:.4g} N</div>")
    if answer.tightening_status is Status.SOLVED:
        lines.append(f"<div>forces for {share:.0%} of the margin:</div>")
    else:
        lines.append(f"<div>no tightening forces: {answer.tightening_status.name}</div>")
    lines.append(_contacts(answer, reasons))
    words = ("explaining ...",) if reasons is None else reasons.words
    lines += [f"<div style='padding-top:0.4em'>{html.escape(line)}</div>" for line in words]
    return f"<div style='{_BOX}'>{''.join(lines)}</div>"


def _margin(answer: Answer, unit: str) -> str:
    if answer.status is Status.SOLVED:
        return f"margin {answer.margin:.5g} {html.escape(unit)}"
    if answer.status is Status.MAX_ITERATIONS:
        return f"margin at least {answer.margin:.5g} {html.escape(unit)}: {answer.status.name}"
    return f"no margin: {answer.status.name}"


def _contacts(answer: Answer, reasons: Reasons | None) -> str:
    """A row a contact: friction, what it presses with of what it may, and how much of its cone it uses."""
    head = "".join(f"<th>{name}</th>" for name in ("contact", "friction", "presses [N]", "pulls aside [N]"))
    rows = []
    for number in np.flatnonzero(answer.active).tolist():
        press, friction = -answer.forces[number] @ answer.normals[number], answer.friction[number]
        across = np.linalg.norm(answer.forces[number] + press * answer.normals[number])
        red, green, blue = (round(255 * part) for part in contact_colour(number))
        ends = " ends the margin" if reasons is not None and number == reasons.binding else ""
        cells = (
            f"<b style='color:rgb({red},{green},{blue})'>{number}</b>{ends}",
            f"{friction:.3g}",
            f"{press:.3g} of {answer.max_force[number]:.3g}",
            f"{across:.3g} of {friction * press:.3g}",
        )
        rows.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    return f"<table style='{_TABLE}'><tr>{head}</tr>{''.join(rows)}</table>"
