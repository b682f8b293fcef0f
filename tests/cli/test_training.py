"""The options of fits, trainings and tasks are the settings of those."""

from dataclasses import fields
from typing import get_type_hints

import pytest
import tyro

from brokk_min.cli.identification import FitSettings
from brokk_min.cli.options import checked
from brokk_min.cli.training import LearnerSettings, TaskSettings
from brokk_min.env import TaskConfig
from brokk_min.identification.fitting import FitConfig
from brokk_min.ppo import PPOConfig

PAIRS = [(FitSettings, FitConfig), (LearnerSettings, PPOConfig), (TaskSettings, TaskConfig)]
FIELDS = [(config, field) for _, config in PAIRS for field in fields(config)]


@pytest.mark.parametrize(("settings", "config"), PAIRS)
def test_settings__have_the_fields_types_and_defaults_of_the_config(settings, config):
    same = {}
    if settings is FitSettings:  # by default by the machine and the log, else:
        same = {"history": 13, "steps": 16000, "weight_decay": 0.0, "noise": 0.1}
    assert get_type_hints(settings).keys() == get_type_hints(config).keys()
    for name, hint in get_type_hints(config).items():
        assert get_type_hints(settings)[name] in (hint, hint | None if name in same else hint)
    assert vars(settings()) | same == vars(config())
    assert checked(config, **vars(settings()) | same) == config()


@pytest.mark.parametrize(("config", "field"), FIELDS, ids=lambda x: getattr(x, "name", ""))
def test_configs__refuse_what_no_setting_can_be(config, field):
    """Each field: text, nan and infinity; below, at and above the ends of its range."""
    bad = ["a", float("nan"), float("inf"), 10**400, [1], 1j]
    if field.metadata:
        low, high = field.metadata["low"], field.metadata["high"]
        low = 0.5 if low == "hold_min_s" else low  # the default of that field
        bad += [True, low - 1e-3 if field.type == "float" else low - 1, 1.01 * high + 1]
        bad += [low + 0.5] if field.type.startswith("int") else []
        ends = (low, high) if field.name != "hold_min_s" else (low, 3.0)
        assert [getattr(config(**{field.name: end}), field.name) for end in ends] == [*ends]
    bad += [] if "None" in field.type else [None]
    for value in bad:
        with pytest.raises(ValueError, match=f"^{field.name}: expected .*, got "):
            config(**{field.name: value})


@pytest.mark.parametrize("option", ["--integral-cost", "--lag-cost"])
def test_task_settings__keep_the_old_name_of_an_option(option):
    settings = tyro.cli(TaskSettings, args=[option, "2.5"])
    assert checked(TaskConfig, **vars(settings)) == TaskConfig(integral_cost=2.5)
