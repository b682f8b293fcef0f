"""Plants of one's own: two functions, in the place of the analytic plant."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_cli import MINI, run

from brokk_min import BROKK_170
from brokk_min.actuator import plant_reset, plant_step
from brokk_min.identification.plants import CheckedPlant, Plant, check_motion

OWN = Path(__file__).parents[2] / "examples" / "own_plant.py"


class Obedient:
    """A stateful one, as a machine on a bus is: joints turn at 0.2 u rad/s."""

    def reset(self, machine, q):
        self.q = q
        return self

    def step(self, machine, state, u):
        self.q = self.q + 0.2 * machine.dt * u
        return self


def test_checked_plant__is_a_plant_as_any_object_of_two_functions():
    plant = CheckedPlant("own", Obedient())
    assert isinstance(plant, Plant) and not isinstance(BROKK_170, Plant)
    machine = replace(BROKK_170, plant=plant)
    state = plant_step(machine, plant_reset(machine, np.ones((2, 5))), np.full((2, 5), 0.5))
    np.testing.assert_allclose(state.q, 1.005)


def test_checked_plant__refuses_angles_changed_in_place():
    """Velocities are differences of old and new angles: they would all be 0."""

    class InPlace(Obedient):
        def step(self, machine, state, u):
            self.q += 0.2 * machine.dt * u
            return self

    plant = CheckedPlant("OWN", InPlace())
    state = plant.reset(BROKK_170, np.ones((2, 5)))
    with pytest.raises(ValueError, match=r"^OWN.step: expected a new array q, got the old one"):
        plant.step(BROKK_170, state, np.full((2, 5), 0.5))


@pytest.mark.parametrize(
    ("unit", "speed", "wanted"),
    [
        (57.3, 0.2, r"OWN.reset: expected angles 0.700 .rad or m. as given, got 40.110"),
        (1.0, 0.0, "q1: expected motion under the largest command, got .0.000 and .0.000"),
        (1.0, -0.2, "q1: expected positive commands to raise q_q1, got -0.252 and .0.252"),
        (1.0, 11.5, "q1: expected angles within its range, got .14.* and -14.*degrees"),
    ],
)
def test_check_motion__refuses_degrees_a_wrong_sign_and_no_motion(unit, speed, wanted):
    class Wrong(Obedient):
        def reset(self, machine, q):
            return super().reset(machine, unit * q)

        def step(self, machine, state, u):
            return super().step(machine, state, speed / 0.2 * u)

    machine = replace(BROKK_170, plant=CheckedPlant("OWN", Wrong()))
    with pytest.raises(ValueError, match=wanted):
        check_motion(machine)
    check_motion(replace(BROKK_170, plant=CheckedPlant("OWN", Obedient())))


@pytest.mark.parametrize(
    ("answer", "got"),
    [(lambda u: u[:, :2], r"array\("), (lambda u: u + np.nan, "nan"), (lambda u: 1 / 0, "zero")],
)
def test_checked_plant__refuses_what_is_no_state(answer, got):
    own = SimpleNamespace(
        reset=lambda machine, q: q, step=lambda machine, state, u: SimpleNamespace(q=answer(u))
    )
    plant = CheckedPlant("OWN", own)
    with pytest.raises(ValueError, match=r"^OWN.reset: expected a state .* attribute 'q'"):
        plant.reset(BROKK_170, np.zeros((4, 5)))
    with pytest.raises(
        ValueError, match=rf"^OWN.step: expected .*angles q .*\(4, 5\), got .*{got}"
    ):
        plant.step(BROKK_170, None, np.zeros((4, 5)))


@pytest.mark.parametrize(
    ("plant", "got"),
    [
        ("net", "--plant: expected one of ['analytic'] or FILE.py:NAME, got net"),
        (f"{OWN}:OwnPlant", "expected an object with reset and step OwnPlant in"),
        (f"{OWN}:TAU", "expected an object with reset and step TAU in"),
    ],
)
def test_commands__refuse_what_is_no_plant(tmp_path, capsys, plant, got):
    """That they take one is in `test_porting.py`."""
    assert run(f"collect --machine '{MINI}' --out '{tmp_path}/log.csv' --plant", plant) == 2
    assert got in capsys.readouterr().err
