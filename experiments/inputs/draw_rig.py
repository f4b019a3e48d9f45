"""The README's picture of the instrument: frames S, P and T, axes, signs and lengths.

    python -m experiments.inputs.draw_rig

Writes data/tutorial/rig.svg. Every ray, mirror and frame is computed by the digital twin's own optics
(`tvsbayes.twin.physics`) and by the transformations of the conventions, so the picture cannot turn an axis the other
way than the code does; `tests/promises/test_tutorial.py` holds it to that. Lengths are those of a tidy drawing, mm.
Colours are of the Okabe-Ito palette; no information is in colour alone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import patches, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common.command_line import print_only
from experiments.common.rows import ROOT
from tvsbayes.instrument.parameters import RIG_PRIORS
from tvsbayes.instrument.stereo_pair import rotation_matrix
from tvsbayes.twin.physics import mirror_chain, to_tvs

OUT = ROOT / "data" / "tutorial" / "rig.svg"
STEREO, POSITIONER, SCANNER, BEAM, GREY, GLASS = "#0072B2", "#D55E00", "#007A5A", "#A0307F", "#555555", "#BFD7EA"
CAMERA_PITCH_MM = 85.0
BASELINE_MM = 200.0
C0_DEG = 90.0
SHEETS_MM = {"d1": 175.0, "d2": 275.0}
T_SP_ROTATION_RAD = np.array([0.0, 0.0, 0.25])
T_SP_MM = np.array([0.0, -200.0, 0.0])
"""Pose of the drawing: farther to the right of the cameras than in the shipped rigs, whose glyphs would overlap."""
PAN_DEG = 11.0
GEOMETRY = {name: prior.value for name, prior in RIG_PRIORS.items()}
"""Nominal mirrors: L 30 mm, no misalignment."""


def in_stereo(points_p_mm: np.ndarray) -> np.ndarray:
    """Points (..., 3) of frame P in frame S: p_S = R_SP p_P + t_SP."""
    return np.asarray(points_p_mm, float) @ rotation_matrix(T_SP_ROTATION_RAD).T + T_SP_MM


def scanner_in_positioner(points_t_mm: np.ndarray) -> np.ndarray:
    """Points (..., 3) of frame T in frame P, the inverse of the twin's own `to_tvs`."""
    origin, *ends = to_tvs(np.vstack([np.zeros(3), np.eye(3)]), BASELINE_MM, C0_DEG)
    return (np.asarray(points_t_mm, float) - origin) @ (np.array(ends) - origin).T


def seen_from_above(points_s_mm: np.ndarray) -> np.ndarray:
    """Page coordinates (..., 2): depth X up the page, Y to the left, Z towards the reader."""
    points = np.asarray(points_s_mm, float)
    return np.stack((-points[..., 1], points[..., 0]), axis=-1)


VIEWER = np.array([-1.0, -1.15, 0.85])
"""Where the second panel is seen from, frame P: behind the instrument, to its right and above it."""


def seen_obliquely(points_p_mm: np.ndarray) -> np.ndarray:
    """Page coordinates (..., 2) of points of frame P in a parallel projection from `VIEWER`."""
    forward = -VIEWER / np.linalg.norm(VIEWER)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.asarray(points_p_mm, float) @ np.stack((right, np.cross(right, forward)), axis=-1)


def beam_to_sheet(pan_deg: float, tilt_deg: float, sheet_mm: float) -> np.ndarray:
    """Mirror 1, the point on mirror 2 and the spot on a sheet of constant X, (3, 3) in S."""
    origin, direction = mirror_chain(*np.radians([pan_deg, tilt_deg]), GEOMETRY)
    start, onward = in_stereo(origin), in_stereo(direction) - T_SP_MM
    return np.array([T_SP_MM, start, start + (sheet_mm - start[0]) / onward[0] * onward])


def arrow(axes: Axes, start: np.ndarray, end: np.ndarray, colour: str, width: float = 1.8) -> None:
    """A straight arrow between page points."""
    style = patches.ArrowStyle("-|>", head_length=0.5, head_width=0.22)
    patch = patches.FancyArrowPatch(start, end, arrowstyle=style, mutation_scale=13, shrinkA=0, shrinkB=0)
    patch.set(color=colour, linewidth=width, zorder=6, joinstyle="miter")
    axes.add_patch(patch)


def curved(axes: Axes, page: np.ndarray, colour: str) -> None:
    """A line through page points (n, 2) with a head at its end."""
    axes.plot(*page[:-1].T, color=colour, lw=1.5, zorder=6)
    arrow(axes, page[-3], page[-1], colour, 1.5)


def dimension(axes: Axes, start: np.ndarray, end: np.ndarray, text: str, offset: tuple[float, float]) -> None:
    """A length between two page points with its text beside the middle."""
    style = {"arrowstyle": "<|-|>", "color": GREY, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=style)
    label(axes, (start + end) / 2, offset, text, GREY)


def label(
    axes: Axes, at: np.ndarray, shift: tuple[float, float], text: str, colour: str = "black", **style: object
) -> None:
    """Words at a page point moved by `shift`."""
    style = {"ha": "center", "va": "center", "zorder": 8, **style}
    axes.text(*np.add(at, shift), text, color=colour, **style)


def camera(axes: Axes, at: np.ndarray) -> None:
    """A camera whose centre of projection is at a page point and which looks up the page."""
    body = np.array([[-11, -22], [11, -22], [11, -6], [4, -6], [8, 0], [-8, 0], [-4, -6], [-11, -6]])
    axes.add_patch(patches.Polygon(at + body, facecolor="#DDDDDD", edgecolor="black", lw=1, zorder=4))


def frame_from_above(
    axes: Axes,
    origin_s: np.ndarray,
    ends_s: np.ndarray,
    names: tuple[str, str],
    colour: str,
    names_at: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Two axes that lie in the page and the dot of the one that points at the reader.

    Names stand at the heads, `names_at` degrees from the direction of their axis, where a line goes on beyond it.
    """
    origin = seen_from_above(origin_s)
    for end, name, aside_deg in zip(seen_from_above(ends_s), names, names_at, strict=True):
        arrow(axes, origin, end, colour)
        c, s = np.cos(np.radians(aside_deg)), np.sin(np.radians(aside_deg))
        ahead = (end - origin) / np.linalg.norm(end - origin) @ np.array([[c, s], [-s, c]])
        label(axes, end, 9 * ahead, name, colour, fontweight="bold")
    axes.add_patch(patches.Circle(origin, 4.6, facecolor="white", edgecolor=colour, lw=1.5, zorder=7))
    axes.add_patch(patches.Circle(origin, 1.5, facecolor=colour, zorder=8))


def turned(start: np.ndarray, first: np.ndarray, second: np.ndarray, radius: float) -> np.ndarray:
    """Arc (n, 2) about a page point from one direction to another, the short way."""
    begin, end = (np.arctan2(*each[::-1]) for each in (first, second))
    sweep = (end - begin + np.pi) % (2 * np.pi) - np.pi
    angles = begin + np.linspace(0, sweep, 40)
    return start + radius * np.stack((np.cos(angles), np.sin(angles)), axis=-1)


def mirror(axes: Axes, middle: np.ndarray, incoming: np.ndarray, outgoing: np.ndarray) -> None:
    """The edge of a mirror that turns one page direction into another."""
    along = incoming / np.linalg.norm(incoming) + outgoing / np.linalg.norm(outgoing)
    edge = middle + np.outer([-11, 11], along / np.linalg.norm(along))
    axes.plot(*edge.T, color="black", lw=3.2, solid_capstyle="butt", zorder=5)


def panel_from_above(axes: Axes) -> None:
    """Stereo pair, positioner, aperture and sheets from above."""
    left, right = seen_from_above([0, 0, 0]), seen_from_above([0, -CAMERA_PITCH_MM, 0])
    aperture_s = in_stereo(scanner_in_positioner([0.0, -BASELINE_MM / 2, 0.0]))
    aperture, pan_axis = seen_from_above(aperture_s), seen_from_above(T_SP_MM)
    for name, depth in SHEETS_MM.items():
        ends = seen_from_above([[depth, 40, 0], [depth, -380, 0]])
        axes.plot(*ends.T, color="black", lw=2.2, solid_capstyle="butt")
        label(axes, ends[1], (0, 9), f"white sheet {name}", ha="right")

    beams = {pan: seen_from_above(beam_to_sheet(pan, 0.0, SHEETS_MM["d2"])) for pan in (0.0, PAN_DEG)}
    pan_axis_again, second, spot = beams[PAN_DEG]
    assert np.allclose(pan_axis_again, pan_axis)
    for eye in (left, right, aperture):
        axes.plot(*np.array([eye, spot]).T, color=GREY, lw=0.9, ls=(0, (5, 3)))
    axes.plot(*beams[0.0][1:].T, color=BEAM, lw=1.1, ls=(0, (1.5, 1.5)))
    axes.plot(*beams[PAN_DEG].T, color=BEAM, lw=2)
    mirror(axes, second, second - pan_axis, spot - second)
    near = seen_from_above(beam_to_sheet(PAN_DEG, 0.0, SHEETS_MM["d1"]))[2]
    for each in (spot, near):
        axes.plot(*each, "o", ms=6.5, color=BEAM, zorder=7)
    label(axes, spot, (0, 13), "laser spot", BEAM)
    label(axes, beams[0.0][2], (5, 9), "beam at pan 0", BEAM, ha="left")
    straight = beams[0.0][2] - beams[0.0][1]
    arc = turned(second, straight, spot - second, 0.78 * np.linalg.norm(straight))
    curved(axes, arc[1:-1], POSITIONER)
    label(axes, arc[0], (9, 3), "pan $\\psi$ > 0: left,\ncounter grows", POSITIONER, ha="left", va="center")

    for eye in (left, right):
        camera(axes, eye)
    frame_from_above(axes, np.zeros(3), np.array([[52, 0, 0], [0, 52, 0]]), ("X", "Y"), STEREO)
    label(axes, left, (0, -31), "left camera", va="top")
    label(axes, right, (0, -31), "right camera", va="top")
    dimension(axes, left, right, f"{CAMERA_PITCH_MM:.0f} mm", (0, 8))
    label(axes, left, (-34, -52), "S: stereo frame, Z up", STEREO, fontweight="bold", va="top", ha="left")

    ends = in_stereo([[58, 0, 0], [0, 44, 0]])
    frame_from_above(axes, T_SP_MM, ends, ("x", "y"), POSITIONER)
    label(axes, pan_axis, (10, -31), "pan axis and mirror 1", va="top")
    label(axes, pan_axis, (-46, -52), "P: positioner frame, z up", POSITIONER, fontweight="bold", va="top", ha="left")
    label(axes, second, (4, -17), "mirror 2", ha="left", va="top")

    scanner_from_above(axes, aperture, second, spot)
    axes.set(xlim=(-82, 425), ylim=(-92, 300))


def scanner_from_above(axes: Axes, aperture: np.ndarray, second: np.ndarray, spot: np.ndarray) -> None:
    """Frame T, the rotating aperture, and the triangle of baseline and angles; page points."""
    pan_axis = seen_from_above(T_SP_MM)
    middle_s = in_stereo(scanner_in_positioner([[0, 0, 0], [58, 0, 0], [0, 32, 0]]))
    axes.plot(*np.array([pan_axis, aperture]).T, color=SCANNER, lw=1.2, ls=(0, (7, 2, 1.5, 2)), zorder=2)
    frame_from_above(axes, middle_s[0], middle_s[1:], ("x", "y"), SCANNER, (0.0, 90.0))
    middle = seen_from_above(middle_s[0])
    text = "T: scanner frame, z up,\norigin in mid-baseline"
    label(axes, aperture, (-72, -41), text, SCANNER, fontweight="bold", va="top", ha="left")
    box = patches.Rectangle(aperture - [9, 9], 18, 18, facecolor="#DDDDDD", edgecolor="black", lw=1, zorder=4)
    axes.add_patch(box)
    label(axes, aperture, (-12, -13), "rotating aperture", va="top", ha="left")
    towards = middle - aperture
    for at, one, other, name, radius in (
        (aperture, towards, spot - aperture, "B", 34),
        (second, -towards, spot - second, "C", 17),
    ):
        page = turned(at, one, other, radius)
        axes.plot(*page.T, color=SCANNER, lw=1.4)
        label(axes, at, (page[20] - at) * (radius + 11) / radius, name, SCANNER, fontweight="bold", fontsize=11)
    below = np.array([-towards[1], towards[0]]) / np.linalg.norm(towards)
    label(axes, (aperture + middle) / 2, 10.5 * below, "a", SCANNER, fontweight="bold", fontsize=11)


def panel_positioner(axes: Axes) -> None:
    """Laser, mirrors, both axes and their positive senses, obliquely."""
    geometry = {**GEOMETRY, "mirror_offset_mm": 46.0}
    raised_deg = 24.0
    chains = {tilt: mirror_chain(0.0, np.radians(tilt), geometry) for tilt in (0.0, raised_deg)}
    second = chains[0.0][0]
    _, y, z = np.eye(3)

    def line(points: object, **style: object) -> None:
        axes.plot(*seen_obliquely(np.array(points, float)).T, **style)

    def plate(middle: np.ndarray, incoming: np.ndarray, outgoing: np.ndarray, over_beam: bool) -> None:
        """A square mirror: its normal halves the angle between where light comes from and goes to."""
        normal = (outgoing - incoming) / np.linalg.norm(outgoing - incoming)
        side = np.cross(incoming, outgoing)
        side /= np.linalg.norm(side)
        edges = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) @ np.stack((side, np.cross(normal, side))) * 13
        page = seen_obliquely(middle + edges)
        axes.add_patch(
            patches.Polygon(
                page, facecolor=GLASS, edgecolor="black", lw=1.1, alpha=0.75, zorder=5.5 if over_beam else 3
            )
        )

    down, across, onward = np.array([0.0, 0, -1]), np.array([0.0, -1, 0]), chains[0.0][1]
    line([[0, 0, -76], [0, 0, 104]], color="black", lw=0.9, ls=(0, (8, 2, 1.5, 2)), zorder=1)
    line([second + 52 * y, second - 50 * y], color="black", lw=0.9, ls=(0, (8, 2, 1.5, 2)), zorder=1)
    plate(np.zeros(3), down, across, False)
    plate(second, across, onward, True)  # seen from its back
    line([[0, 0, 60], [0, 0, 0], second, second + 112 * onward], color=BEAM, lw=2, zorder=5)
    line([second, second + 112 * chains[raised_deg][1]], color=BEAM, lw=1.1, ls=(0, (1.5, 1.5)), zorder=5)
    arrow(axes, *seen_obliquely([[0, 0, 36], [0, 0, 24]]), BEAM)
    for direction in (onward, chains[raised_deg][1]):
        arrow(axes, *seen_obliquely([second + 96 * direction, second + 114 * direction]), BEAM, 1.2)
    page = seen_obliquely([[0, 0, 60], [0, 0, 86]])
    axes.plot(*page.T, color="#444444", lw=11, solid_capstyle="butt", zorder=6)
    label(axes, page.mean(axis=0), (-12, 0), "laser", ha="right")
    axes.add_patch(patches.Circle(seen_obliquely(np.zeros(3)), 1.8, facecolor=POSITIONER, zorder=9))

    for end, name, shift in (([52, 0, 0], "x", (6, 3)), ([0, 52, 0], "y", (-6, 4)), ([0, 0, 50], "z", (7, 2))):
        head = seen_obliquely(np.array(end, float))
        arrow(axes, seen_obliquely(np.zeros(3)), head, POSITIONER)
        label(axes, head, shift, name, POSITIONER, fontweight="bold")
    ring = np.radians(np.linspace(-150, 60, 60))
    circle = np.stack((21 * np.cos(ring), 21 * np.sin(ring), np.full(60, -58.0)), axis=-1)
    curved(axes, seen_obliquely(circle), POSITIONER)
    text = "pan $\\psi$ > 0: left, counter\ngrows, both mirrors turn"
    label(axes, seen_obliquely([0, 0, -62]), (22, -10), text, POSITIONER, ha="left", va="top")
    label(axes, seen_obliquely([0, 0, 104]), (0, 4), "pan axis", va="bottom")
    tilts = np.radians(np.linspace(1, raised_deg - 1, 30))
    lifts = second + 84 * mirror_chain(0.0, tilts, geometry).direction
    curved(axes, seen_obliquely(lifts), POSITIONER)
    label(axes, seen_obliquely(lifts[-1]), (-4, 22), "tilt $\\beta$ > 0: up,\ncounter grows", POSITIONER, va="bottom")
    label(axes, seen_obliquely([0, 0, 0]), (-21, -10), "mirror 1", ha="right")
    label(axes, seen_obliquely(second), (19, -2), "mirror 2", ha="left")
    label(axes, seen_obliquely(second - 50 * y), (3, -1), "tilt axis", ha="left")
    dimension(axes, *(seen_obliquely([[0, 0, -21], second - 21 * z])), "L", (-4, -6))
    axes.set(xlim=(-66, 150), ylim=(-112, 118))


def main() -> None:
    """Draw both panels and write the SVG; the same bytes every time with the same matplotlib."""
    print_only(__doc__)
    style = {"font.size": 10.5, "svg.hashsalt": "tvsbayes", "mathtext.fontset": "dejavusans"}
    with rc_context(style):
        drawn().savefig(OUT, metadata={"Date": None, "Creator": None})
    print(OUT.relative_to(Path.cwd()) if OUT.is_relative_to(Path.cwd()) else OUT)


def drawn() -> Figure:
    """Both panels."""
    figure = Figure(figsize=(10.4, 4.9))
    above = figure.add_axes((0.005, 0.0, 0.60, 0.94))
    near = figure.add_axes((0.625, 0.0, 0.37, 0.94))
    for axes in (above, near):
        axes.set_aspect("equal")
        axes.axis("off")
        axes.patch.set_visible(False)
    figure.text(0.05, 0.965, "From above", fontweight="bold", va="center")
    figure.text(0.655, 0.965, "The positioner at pan 0, tilt 0", fontweight="bold", va="center")
    panel_from_above(above)
    panel_positioner(near)
    return figure


if __name__ == "__main__":
    main()
