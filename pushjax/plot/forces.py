"""The forces of a trajectory as vectors."""

from typing import NamedTuple

import numpy as np

from pushjax.simulation.trajectory import Trajectory


class ContactForces(NamedTuple):
    """The forces on the slider at each contact, halfway through each step, in its body frame of that moment.

    Attributes:
        point: (steps, contacts, 2), points of contact, m; zero where nothing pushes.
        force: (steps, contacts, 2), N, along x and y; zero where nothing pushes.
    """

    point: np.ndarray
    force: np.ndarray


def contact_forces(push: Trajectory) -> ContactForces:
    """Return the forces of a trajectory, and the points where they act."""
    components, normal = np.asarray(push.force, float), np.asarray(push.contact_normal, float)
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    return ContactForces(
        np.asarray(push.contact_point, float), components[..., :1] * normal + components[..., 1:] * tangent
    )
