"""Shapes from a machine's geometry: where they stand, and what touches what."""

import numpy as np
import pytest
from helpers_bus import START
from hypothesis import given
from strategies import moving

from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170
from brokk_min.viewer import shapes


@pytest.mark.parametrize(
    ("q", "text", "links"),
    [
        (START, None, set()),
        ((0.4, 1.4, 1.6, 0.6, 0.0), "the arm touches itself", {5, 9}),
        ((0.0, 0.0, -0.3, 1.6, 0.0), "the arm touches the ground", None),
    ],
)
def test_contacts__of_poses_seen_by_eye(q, text, links):
    found = shapes.contacts(BROKK_170, np.array(q))
    assert (text in found) == (text is not None)
    if links:
        assert links <= found[text]


@given(moving([()]))
def test_shapes__of_any_machine_are_finite(machine_moving):
    machine, q, _ = machine_moving
    for part in [*shapes.undercarriage(machine), shapes.turret(machine, q)]:
        assert np.isfinite(part).all()
    for links in shapes.contacts(machine, q).values():
        assert all(0 <= i < 2 * machine.n for i in links)


def test_near_singular__compares_the_least_singular_value_with_the_arms_length():
    length = 0.95 + 0.25 + 1.15 + 1.25 + 1.15 + 1.2
    length += np.hypot(0.25, 0.95) - 0.25 - 0.95
    for q3 in np.linspace(-0.3, 1.6, 20):
        q = np.array([0.0, 0.5, q3, 2.9, 1.9])
        J = jacobian(forward_kinematics(BROKK_170, q))[:, [0, 2, 3, 4]]
        least = np.sqrt(np.linalg.eigvalsh(J @ J.T)[0])
        assert shapes.near_singular(BROKK_170, q) == (least < 0.1 * length)
