"""Pictures of a contact problem: one contact with its cones, or two fingers that close and may jam."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pushjax.contact.cones import friction_cone, motion_cone
from pushjax.contact.problem import Contacts, Motion
from pushjax.contact.status import Status
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.support import Support
from pushjax.geometry.shape import Shape
from pushjax.plot.parts import arrow, center_of_rotation, outline
from pushjax.plot.style import BLACK, BLUE, GRAY, GREEN, MM, ORANGE, PURPLE, STYLE, legend_below, panel_row


def motion_cone_figure(
    shape: Shape, support: Support, surface: LimitSurface, contacts: Contacts, motion: Motion
) -> Figure:
    """Draw one contact with its friction cone and motion cone.

    The picture also shows the support points, the push, and the center of rotation with its sign.

    Args:
        shape: Outline of the slider.
        support: Support of the slider.
        surface: Limit surface of the slider.
        contacts: The contacts in the body frame, m. The first one is drawn. Its displacement must not be zero.
        motion: What `solve_contacts` gives for them.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(5.6, 4.9), layout="constrained")
        outline(axes, shape, np.zeros(3), BLACK, 1.4)
        axes.plot(*(MM * np.asarray(support.point)).T, ".", color=GRAY, ms=3, label="support points")
        point, normal = np.asarray(contacts.point[0]), np.asarray(contacts.normal[0])
        mu = float(contacts.friction[0])
        reach = 0.45 * float(np.max(np.asarray(shape.bounds[1] - shape.bounds[0])))
        cones = (
            ("friction cone", friction_cone(normal, mu), GREEN, "--"),
            ("motion cone", motion_cone(surface, point, normal, mu), BLUE, "-"),
        )
        for name, edges, color, linestyle in cones:
            ends = MM * (point + reach * np.asarray(edges))
            for k, end in enumerate(ends):
                label = name if k == 0 else None
                axes.plot(*np.array([MM * point, end]).T, linestyle, color=color, lw=1.6, label=label)
            axes.fill(*np.array([MM * point, *ends]).T, color=color, alpha=0.10, lw=0)
        push = np.asarray(contacts.displacement[0])
        push = 0.5 * reach * push / np.linalg.norm(push)
        arrow(axes, MM * (point - push), MM * point, ORANGE, 2.2)
        axes.plot([], [], color=ORANGE, lw=2.2, label="push")
        center_of_rotation(axes, np.asarray(motion.twist))
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)
        return figure


def jam_figure(shape: Shape, panels: list[tuple[Contacts, Motion]]) -> Figure:
    """Draw two fingers that close, to show why they jam or do not.

    Each panel shows:

    - the friction cones and the contact normals;
    - the regions of the centers of rotation that move both contacts away from their fingers, by the sign of the
      rotation: counterclockwise (+) or clockwise (-);
    - the line through the contacts; the fingers press on each other along it if it lies in both cones;
    - the status, and the center of rotation of the solution.

    Args:
        shape: Outline of the slider.
        panels: For each panel the two contacts, in the body frame and of equal friction, and their solution.
    """
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(panels), 5.0, 4.6)
        low, high = (MM * np.asarray(b) for b in shape.bounds)
        reach = 0.55 * (high - low).max()
        box = low - 0.4 * reach, high + 0.4 * reach
        for axes, (contacts, motion) in zip(all_axes, panels, strict=True):
            point, normal = MM * np.asarray(contacts.point), np.asarray(contacts.normal)
            mu = np.asarray(contacts.friction)
            _allowed_centers(axes, point, normal, box)
            outline(axes, shape, np.zeros(3), BLACK, 1.4)
            for name, p, n, m in zip("AC", point, normal, mu, strict=True):  # the names of `experiments.jam`
                _labeled_contact(axes, name, p, n, m, reach)
            axes.plot(*point.T, ":", color="0.2", lw=1.3)
            center_of_rotation(axes, np.asarray(motion.twist))
            axes.plot([], [], color=GREEN, label="friction cone")
            axes.plot([], [], "--", color=BLUE, lw=0.9, label="contact normal")
            axes.plot([], [], ":", color="0.2", label="line through both contacts")
            status = Status(int(motion.status)).name
            axes.set(title=f"$\\mu$ = {mu[0]:.2f}: {status}", xlabel="x / mm", ylabel="y / mm", aspect="equal")
            axes.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]))
        legend_below(figure, all_axes[0], columns=3)
        return figure


def _allowed_centers(axes: Axes, point: np.ndarray, normal: np.ndarray, box: tuple[np.ndarray, np.ndarray]) -> None:
    """Draw where a center of rotation of either sign moves all contacts away from their fingers."""
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, 301) for a, b in zip(*box, strict=True))), axis=-1)
    arm = point[:, None, None] - grid[None]
    # A counterclockwise turn about c moves p along perp(p - c).
    away = -normal[:, None, None, 0] * arm[..., 1] + normal[:, None, None, 1] * arm[..., 0]
    for sign, color in ((1, ORANGE), (-1, PURPLE)):
        region = np.all(sign * away > 0, axis=0)
        if region.any():
            axes.contourf(grid[..., 0], grid[..., 1], region, levels=[0.5, 1.5], colors=[color], alpha=0.16)
            label = "center of rotation allowed, " + ("+" if sign > 0 else "\N{MINUS SIGN}")
            axes.fill([], [], color=color, alpha=0.16, label=label)


def _labeled_contact(
    axes: Axes,
    name: str,
    point: np.ndarray,  # (2,), mm
    normal: np.ndarray,  # (2,), unit vector into the slider
    mu: float,
    reach: float,  # length that the lengths of the lines are multiples of, mm
) -> None:
    """Draw the normal, the friction cone and the closing finger of a contact."""
    axes.plot(*np.array([point - 2 * reach * normal, point + 2 * reach * normal]).T, "--", color=BLUE, lw=0.9)
    tangent = np.array([-normal[1], normal[0]])
    for side in (1, -1):
        edge = (normal + side * mu * tangent) / np.hypot(1, mu)
        axes.plot(*np.array([point, point + 0.9 * reach * edge]).T, color=GREEN, lw=1.6)
    arrow(axes, point - 0.4 * reach * normal, point, "0.3", 1.8)
    axes.annotate(name, tuple(point - 0.5 * reach * normal), ha="center", va="center")
