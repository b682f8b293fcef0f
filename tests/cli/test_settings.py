"""The options of fits, trainings and tasks are the settings of those."""

from __future__ import annotations

from typing import Annotated, Literal, get_args, get_origin, get_type_hints

import pytest
import tyro

from brokk_min.cli.options import Range, WrongUse, check_ranges
from brokk_min.cli.settings import FitSettings, LearnerSettings, TaskSettings
from brokk_min.env import TaskConfig
from brokk_min.identification.fitting import FitConfig
from brokk_min.ppo import PPOConfig

PAIRS = [(FitSettings, FitConfig), (LearnerSettings, PPOConfig), (TaskSettings, TaskConfig)]


@pytest.mark.parametrize(("settings", "config"), PAIRS)
def test_settings__have_the_fields_types_and_defaults_of_the_config(settings, config):
    assert get_type_hints(settings) == get_type_hints(config)
    assert vars(settings()) == vars(config())
    assert config(**vars(settings())) == config()


@pytest.mark.parametrize("settings", [pair[0] for pair in PAIRS])
def test_settings__have_one_range_per_number(settings):
    check_ranges(settings())
    for name, hint in get_type_hints(settings, include_extras=True).items():
        if hint is not bool and get_origin(hint) is not Literal:
            assert get_origin(hint) is Annotated, name
            assert sum(isinstance(extra, Range) for extra in get_args(hint)) == 1, name


def test_task_settings__need_a_longest_time_above_the_shortest():
    assert TaskSettings(hold_min_s=2.0, hold_max_s=2.0).config().hold_max_s == 2.0
    with pytest.raises(WrongUse, match=r"^--hold-max-s: expected --hold-min-s or more, got 0.5$"):
        TaskSettings(hold_min_s=0.75, hold_max_s=0.5).config()


@pytest.mark.parametrize("option", ["--integral-cost", "--lag-cost"])
def test_task_settings__keep_the_old_name_of_an_option(option):
    assert tyro.cli(TaskSettings, args=[option, "2.5"]).config() == TaskConfig(integral_cost=2.5)
