"""Draws the four-bar linkage, its frames and angles, at the tutorial's initial state: ``python docs/linkage.py``."""

from itertools import pairwise
from pathlib import Path

import numpy as np

import fourbar_codegen as fb

SCALE, ORIGIN, SIZE = 330.0, np.array([200.0, 90.0]), (560, 360)
LENGTHS = {"l1": 0.8, "l2": 0.5, "l3": 1.0, "l4": 0.7}
LINK, FORCE, FRAME, ANGLE = "#1c1c1c", "#b45309", "#15803d", "#0b57b0"


def place(point):
    """Pixels of a point in metres."""
    return ORIGIN + SCALE * np.array([1.0, -1.0]) * np.asarray(point)[:2]


def direction(angle):
    """Along the x axis of a link."""
    return np.array([np.cos(angle), np.sin(angle)])


def text(at, label, color, anchor="middle"):
    """A label; what is behind an underscore stands lower."""
    x, y = at
    name, _, index = label.partition("_")
    lower = f'<tspan dy="4" font-size="11">{index}</tspan>' if index else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{color}" text-anchor="{anchor}">{name}{lower}</text>'


def line(a, b, color, width, more=""):
    """From one place to another."""
    (x1, y1), (x2, y2) = a, b
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{color}" stroke-width="{width}" stroke-linecap="round" {more}/>'


def arrow(a, b, color, width=2):
    """A line with a tip."""
    return line(a, b, color, width, f'marker-end="url(#tip-{color[1:]})"')


def arc(center, begin, end, radius, label):
    """The angle between two directions about a joint, with its name beside the middle."""
    a, b = (place(center + radius * direction(angle)) for angle in (begin, end))
    large, sweep = int(abs(end - begin) > np.pi), int(end < begin)
    path = f"M{a[0]:.1f} {a[1]:.1f}A{SCALE * radius:.1f} {SCALE * radius:.1f} 0 {large} {sweep} {b[0]:.1f} {b[1]:.1f}"
    x, y = place(center + (radius + 0.06) * direction((begin + end) / 2))
    return (
        f'<path d="{path}" fill="none" stroke="{ANGLE}" stroke-width="1.5" marker-end="url(#tip-{ANGLE[1:]})"/>'
        + text((x, y + 5), label, ANGLE)
    )


def drawing():
    """The SVG."""
    four_bar = fb.load("four_bar")
    q = four_bar.initial_state()[:3]
    angles = np.cumsum(q)
    start, joints = np.array([-0.4, 0.0]), [np.array([0.4, 0.0])]
    for angle, length in zip(angles, (0.5, 1.0, 0.7), strict=True):
        joints.append(joints[-1] + length * direction(angle))
    parts = [  # of text, in the order in which they are drawn
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIZE[0]} {SIZE[1]}" font-family="sans-serif"',
        'font-size="15" font-style="italic"><title>The four-bar linkage</title>',
        f'<rect width="{SIZE[0]}" height="{SIZE[1]}" fill="white"/>',
        *(
            f'<marker id="tip-{color[1:]}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
            f'orient="auto"><path d="M0 0L8 4L0 8z" fill="{color}"/></marker>'
            for color in (FORCE, FRAME, ANGLE)
        ),
    ]
    for end in (start, joints[0]):  # fixed to the ground
        x, y = place(end)
        parts.append(line((x - 16, y - 14), (x + 16, y - 14), LINK, 2))
        parts += [line((x - 14 + 8 * i, y - 14), (x - 9 + 8 * i, y - 22), LINK, 1.2) for i in range(4)]
        parts += [line((x, y), (x - 9, y - 14), LINK, 1.5), line((x, y), (x + 9, y - 14), LINK, 1.5)]
    parts.append(line(place(start), place(joints[0]), "#8a8f98", 2, 'stroke-dasharray="6 5"'))
    parts += [line(place(a), place(b), LINK, 5) for a, b in pairwise(joints)]
    # Each angle from the direction of the link before, drawn dashed beyond the joint.
    before = 0.0
    for number, (joint, angle) in enumerate(zip(joints, angles, strict=False), start=1):
        parts.append(line(place(joint), place(joint + 0.2 * direction(before)), ANGLE, 1.2, 'stroke-dasharray="4 4"'))
        parts.append(arc(joint, before, angle, 0.13, f"q_{number}"))
        before = angle
    for end in (start, *joints[:3]):
        x, y = place(end)
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="white" stroke="{LINK}" stroke-width="2"/>')
    for tip, name, beside in (([0.15, 0.0], "N.x", [0.14, 0.03]), ([0.0, 0.15], "N.y", [0.06, 0.13])):
        parts += [arrow(place([0.0, 0.0]), place(tip), FRAME), text(place(beside), name, FRAME)]
    parts += [
        arrow(place(joints[2]), place(joints[2] + [0.22, 0.0]), FORCE, 3),
        text(place(joints[2] + [0.2, -0.07]), "F(t)", FORCE),
    ]
    parts += [arrow((500, 240), (500, 290), FORCE, 2), text((515, 270), "g", FORCE)]
    parts.append(text((452, 60), "torque on link 2: \u2212k q\u2082 \u2212 c u\u2082", FORCE))
    names = {
        "link 1 (ground), l_1": [0.05, -0.07], "link 2, l_2": [0.13, -0.01], "link 3, l_3": [0.02, -0.09],
        "link 4, l_4": [-0.17, 0.0],
    }  # fmt: skip
    for (a, b), (name, beside) in zip(pairwise([start, *joints]), names.items(), strict=True):
        parts.append(text(place((a + b) / 2 + beside), name, LINK))
    labels = [("P_1", [-16, 24]), ("P_2", [20, -4]), ("P_3", [-4, 24])]
    for joint, (label, shift) in zip(joints, labels, strict=False):
        parts.append(text(place(joint) + shift, label, LINK))
    return "\n".join([*parts, "</svg>\n"])


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(drawing())
