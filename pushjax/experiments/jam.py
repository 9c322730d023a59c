"""Two fingers close on a slider and jam: the status, its friction threshold, and a picture that proves it.

Contacts A and C lie on opposite faces, a distance 2 a apart along their normals and 2 h apart across them (the paper's
moment labeling example). To let the fingers close, the slider must turn counterclockwise about a center in the band
between the two normals. The contacts then slide, and friction acts along one edge of each cone. The moment of those
edges about the middle is proportional to h - mu a. So beyond mu = h / a the forces of the fingers cannot turn the
slider that way, and no twist satisfies both contacts. At the same friction the line AC enters both friction cones. The
fingers can then press against each other along this line, which is the squeeze certificate. Neither argument depends on
the limit surface.

Reference: Zhou et al. 2017, section IV.B, figure on jamming; Mason 2001 for moment labeling.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax import plot
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table, saved, table
from pushjax.experiments._slider_options import fitted_surface

HALF_WIDTH, HALF_OFFSET = 0.030, 0.012  # a and h of the header, m
THRESHOLD = HALF_OFFSET / HALF_WIDTH  # friction from which the fingers jam, by statics alone
CLOSING = 0.001  # displacement of each finger, m
BELOW, ABOVE = 0.25, 0.55  # frictions that are drawn
THRESHOLD_DISTANCE = 1e-3  # relative distance from the threshold to the nearest friction on either side of it


def contacts(friction) -> pj.Contacts:
    """Return contacts A (left, low) and C (right, high), in the body frame, of the closing fingers."""
    # the closing fingers turn the slider counterclockwise
    point = jnp.array([[-HALF_WIDTH, -HALF_OFFSET], [HALF_WIDTH, HALF_OFFSET]])
    normal = jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    return pj.Contacts(point, normal, CLOSING * normal, friction)


def run(seed: int = 0, out: Path | None = None) -> dict[str, Any]:
    """Find the status over friction with both surfaces, and compare the threshold found with the expected one.

    Args:
        seed: Seed of the wrench-twist pairs that the surfaces are fitted to.
        out: Folder for the pictures. None: no pictures.

    Returns:
        The record. It has one row per surface: the smallest friction that jams, the largest that moves, the threshold
        by statics, and all statuses. `verdicts` holds the status at the two drawn frictions.
    """
    block = pj.Polygon.rectangle(2 * HALF_WIDTH, 0.05)
    support = pj.Support.uniform(block, points=64)
    near_threshold = THRESHOLD * (1 + THRESHOLD_DISTANCE * jnp.array([-1.0, 1.0]))
    scanned = jnp.sort(jnp.append(jnp.linspace(0.0025, 0.7975, 160), near_threshold))
    frictions = jnp.append(scanned, jnp.array((BELOW, ABOVE)))  # the drawn ones last; one program solves all
    rows, motions = [], {}
    for name in ("ellipsoid", "quartic"):
        surface = fitted_surface(support, name, seed)
        motion_by_friction = jax.jit(jax.vmap(lambda mu, s=surface: pj.solve_contacts(s, contacts(mu))))(frictions)
        status = np.asarray(motion_by_friction.status)[: len(scanned)]
        jammed, moving = status == pj.Status.JAMMED, status == pj.Status.MOVING
        rows.append(
            {
                "model": name,
                "jams_from": float(scanned[np.argmax(jammed)]) if jammed.any() else None,
                "last_moving": float(scanned[np.flatnonzero(moving)[-1]]),
                "threshold": THRESHOLD,
                "statuses": sorted({pj.Status(int(s)).name for s in status}),
            }
        )
        motions[name] = motion_by_friction
    drawn = [jax.tree.map(lambda leaf, k=k: leaf[k], motions["quartic"]) for k in (-2, -1)]
    verdicts = {str(mu): pj.Status(int(m.status)).name for mu, m in zip((BELOW, ABOVE), drawn, strict=True)}
    panels = [(contacts(mu), motion) for mu, motion in zip((BELOW, ABOVE), drawn, strict=True)]
    pictures = saved(out, lambda: {"jam.png": plot.jam_figure(block, panels)})
    settings = {"seed": seed, "half_width_m": HALF_WIDTH, "half_offset_m": HALF_OFFSET, "closing_m": CLOSING}
    return result_record("jam", settings, rows=rows, verdicts=verdicts, pictures=pictures)


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    verdicts = [{"friction": mu, "status": status} for mu, status in record["verdicts"].items()]
    return [
        f"Two fingers close on opposite faces, offset: statics says they jam from a friction of {THRESHOLD:.4f}.",
        table(
            record["rows"],
            ("surface", "model"),
            ("moves up to", "last_moving", ".4f"),
            ("jams from", "jams_from", ".4f"),
        ),
        table(verdicts, ("friction", "friction"), ("status", "status")),
    ]
