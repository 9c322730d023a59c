"""Two fingers that close on a slider and jam: the verdict, its threshold, and the picture that proves it.

Contacts A and C lie on opposite faces, a distance 2 a apart along their normals and 2 h across (the paper's moment
labelling example). To let the fingers close, the slider must turn about a centre in the band between the two normals,
counter-clockwise. The faces then slip, friction acts along one edge of each cone, and the moment of those edges about
the middle is proportional to h - mu a. So beyond mu = h / a the fingers' forces cannot turn it that way: no twist
satisfies both contacts. At the same friction the line AC enters both friction cones, and the fingers can press against
each other along it, which is the squeeze certificate. Neither depends on the limit surface.

Source: Zhou et al. 2017, section IV.B, figure on jamming; Mason 2001 for moment labelling.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.report import envelope

HALF_WIDTH, HALF_OFFSET = 0.030, 0.012  # a and h, m
CLOSING = 0.001  # of each finger, m
BELOW, ABOVE = 0.25, 0.55  # frictions drawn
NEAR = 1e-3  # of the threshold: the nearest frictions on both sides of it


def contacts(friction) -> pj.Contacts:
    """A on the left, low; C on the right, high: closing turns the slider counter-clockwise."""
    point = jnp.array([[-HALF_WIDTH, -HALF_OFFSET], [HALF_WIDTH, HALF_OFFSET]])
    normal = jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    return pj.Contacts(point, normal, CLOSING * normal, friction)


def threshold() -> float:
    """The friction at which it jams, by statics alone."""
    return HALF_OFFSET / HALF_WIDTH


def surfaces(seed: int) -> tuple[pj.Polygon, dict[str, pj.LimitSurface]]:
    block = pj.Polygon.rectangle(2 * HALF_WIDTH, 0.05)
    pairs = pj.Support.uniform(block, points=64).wrench_twist_pairs(jax.random.key(seed), 400)
    return block, {name: pj.fit_limit_surface(*pairs, degree=d) for name, d in (("ellipsoid", 2), ("quartic", 4))}


def run(seed: int = 0, out: Path | None = None) -> dict[str, Any]:
    """The status over friction with both surfaces, the threshold found and expected; the picture into `out`."""
    block, both = surfaces(seed)
    close = threshold() * (1 + NEAR * jnp.array([-1.0, 1.0]))
    scanned = jnp.sort(jnp.append(jnp.linspace(0.0025, 0.7975, 160), close))
    frictions = jnp.append(scanned, jnp.array((BELOW, ABOVE)))  # one program for both
    rows, motions = [], {}
    for name, surface in both.items():
        solved = jax.jit(jax.vmap(lambda mu, s=surface: pj.solve_contacts(s, contacts(mu))))(frictions)
        status = np.asarray(solved.status)[: len(scanned)]
        jammed, moves = status == pj.Status.JAMMED, status == pj.Status.MOVING
        rows.append(
            {
                "model": name,
                "jams_from": float(scanned[np.argmax(jammed)]) if jammed.any() else None,
                "last_moving": float(scanned[np.flatnonzero(moves)[-1]]),
                "threshold": threshold(),
                "statuses": sorted({pj.Status(int(s)).name for s in status}),
            }
        )
        motions[name] = solved
    drawn = [jax.tree.map(lambda leaf, k=k: leaf[k], motions["quartic"]) for k in (-2, -1)]
    verdicts = {str(mu): pj.Status(int(m.status)).name for mu, m in zip((BELOW, ABOVE), drawn, strict=True)}
    pictures = [] if out is None else _draw(out, block, drawn)
    settings = {"seed": seed, "half_width_m": HALF_WIDTH, "half_offset_m": HALF_OFFSET, "closing_m": CLOSING}
    return envelope("jam", settings, rows=rows, verdicts=verdicts, pictures=pictures)


def _draw(out: Path, block: pj.Polygon, motions: list[pj.Motion]) -> list[str]:
    from pushjax import plot

    panels = [(contacts(mu), motion) for mu, motion in zip((BELOW, ABOVE), motions, strict=True)]
    return [str(plot.save(plot.jam_figure(block, panels), out / "jam.png"))]


def summary(record: dict[str, Any]) -> str:
    """What the command prints."""
    lines = [f"Two fingers close on opposite faces, offset: statics says they jam from mu = {threshold():.4f}."]
    for row in record["rows"]:
        jams = "never jams" if row["jams_from"] is None else f"jams from {row['jams_from']:.4f}"
        lines.append(f"  {row['model']:10} moves up to mu = {row['last_moving']:.4f}, {jams}")
    lines += [f"  mu = {mu}: {status}" for mu, status in record["verdicts"].items()]
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)
