"""Joints that are not alone, by hand: who explains whose error; how late a joint answers."""

import numpy as np
import pytest

from brokk_min.identification import coupling
from brokk_min.identification.logs import Log, Recording, join_recordings, velocity_of


def test_explained__is_judged_on_the_rows_that_were_not_fitted():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4000, 2))
    noise = rng.standard_normal(4000)
    y = x @ [1.0, 2.0]
    assert coupling.explained(x, y) == pytest.approx(1.0)
    assert coupling.explained(x, y + 5**0.5 * noise) == pytest.approx(0.5, abs=0.1)
    assert coupling.explained(x, noise) < 0.05


@pytest.mark.parametrize("late", [4, 9])
def test_response_delays__of_a_pure_delay(late):
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, 60), 10)
    u = np.stack([u, np.zeros_like(u)], axis=1)
    speed = np.concatenate([np.zeros(late), u[:-late, 0]])
    q = np.cumsum(np.stack([speed, 0 * speed], 1), axis=0) / 20
    log = Log(("a", "b"), (Recording("run", u, q, velocity_of(q, 2)),))
    delays = coupling.response_delays(log)
    assert delays[0] == pytest.approx(late / 20)
    assert np.isnan(delays[1])
    assert coupling.history_of(log, 2) == late + 5  # and a quarter of a second
    assert coupling.history_of(log, 30) == 30


def test_coupling__names_the_joint_that_slows_the_other():
    """Joint a is slowed by a fifth of b's speed; the errors are of nets that do not know."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(0, 1, (200, 2)), 20, axis=0)
    speed = u - 0.2 * u[:, ::-1] * [1, 0]
    log = Log(("a", "b"), (Recording("run", u, np.cumsum(speed, axis=0) / 20, speed),))
    starts = np.arange(0, 3980, 20)
    rows = starts + np.arange(20)[:, None]
    errors = u[rows] - speed[rows] + 0.001 * rng.standard_normal((20, 199, 2))
    found = coupling.coupling(join_recordings(log), starts, errors)
    assert found[0, 1] > 0.8
    assert found[1, 0] < 0.1
    assert np.isnan(np.diagonal(found)).all()
    few = coupling.coupling(join_recordings(log), starts[:30], errors[:, :30])
    assert np.isnan(few).all()
