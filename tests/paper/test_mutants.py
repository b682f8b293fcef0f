"""Planted errors: each must be found, by an assertion, by the test that claims the property.

A planted error replaces one piece of a function's source. The changed function's code takes the place of the
right one, in the same function object, so that whoever imported it runs the wrong code. Tests are taken from
private copies of their files, with properties that stop at the first example that fails. The safety gate
has mutants of its own (`test_gate.py`).
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import itertools
import types
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, settings

from brokk_min.machine import BROKK_170

# module, right, wrong, the test that must fail: by module of the package
PLANTED: list[tuple[str, str, str, str]] = [
    # sine for cosine in DH; hands of the axes; the row's order; the Jacobian
    ("kinematics", "[share - 1, tangent * share]", "[1 - share, tangent * share]",
     "kinematics::cosines_and_sines_also_of_half_turns"),
    ("kinematics", "s * x + c * y, c * x - s * y", "c * x - s * y, s * x + c * y",
     "kinematics::closed_form_of_the_brokk"),
    ("kinematics", "np.cos(alpha), -np.sin(alpha)], [np.sin(alpha)",
     "np.cos(alpha), np.sin(alpha)], [-np.sin(alpha)",
     "kinematics::frames_are_the_product_of_exponentials"),
    ("kinematics", "np.outer(before.T", "np.outer(-before.T", "kinematics::the_start_pose_of_the_paper"),
    ("kinematics", "(before @ theta", "(-before @ theta", "kinematics::closed_form_of_the_brokk"),
    ("kinematics", "summed[i] += summed[i - 1]", "summed[i] -= summed[i - 1]",
     "kinematics::closed_form_of_the_brokk"),
    ("kinematics", "links[i - 1] += links[i]", "links[i] += links[i - 1]",
     "kinematics::closed_form_of_the_brokk"),
    ("kinematics", "run[:, None] == run", "run[:, None] >= run",
     "kinematics::frames_are_the_product_of_exponentials"),
    ("kinematics", "= -links[:, 1], links[:, 0]", "= links[:, 1], -links[:, 0]",
     "kinematics::jacobian_is_the_derivative_of_the_tool_position"),
    ("kinematics", "columns[0, start:end] -= y", "columns[0, start:end] += y",
     "kinematics::tool_velocity_is_the_derivative_along_the_motion"),
    ("kinematics", "[1][..., machine.driven]", "[1][..., : len(machine.driven)]",
     "kinematics::driven_joints_move_the_tool_through_the_jacobian_and_locked_ones_add_to_it"),
    ("kinematics", "(0.06 * length) ** 2", "0.06 * length",
     "kinematics::joint_rates_solve_the_normal_equations"),
    ("kinematics", "bz_x * v[0] - bz_y * y)", "bz_x * v[0] + bz_y * y)",
     "kinematics::joint_rates_solve_the_normal_equations"),
    ("kinematics", "np.maximum.reduce", "np.minimum.reduce", "kinematics::lowest_point_by_hand"),
    ("kinematics", "reduce(rises[1:]", "reduce(rises[-1:]", "kinematics::lowest_point_by_hand"),
    # bytes, limit, encoder, velocity
    ("machine", "255 + counts", "256 + counts", "machine::opposite_commands_have_bytes_that_sum_to_255"),
    ("machine", "u_byte > PWM_MAX, u_byte - 255", "u_byte >= PWM_MAX, u_byte - 255",
     "machine::every_byte_is_told_by_the_rule_of_the_paper"),
    ("machine", "np.clip(np.rint(u * PWM_MAX)", "np.clip(np.floor(u * PWM_MAX)",
     "machine::no_command_leaves_beyond_the_limit_or_between_counts"),
    ("machine", "-machine.pwm_limit, machine.pwm_limit)", "-machine.pwm_limit - 1, machine.pwm_limit)",
     "machine::the_limit_is_80_counts_of_127"),
    ("machine", "np.rint(q / machine.encoder_step)", "np.floor(q / machine.encoder_step)",
     "machine::encoders_report_the_nearest_count"),
    ("machine", "q[..., -samples:], weights", "q[..., :samples], weights",
     "machine::velocity_is_the_least_squares_slope_and_forgets_what_is_older"),
    ("machine", "lags @ lags * dt", "lags @ lags", "machine::velocity_by_hand"),
    # plant
    ("plant", "- 2 * base * rod * np.cos(angle)", "+ 2 * base * rod * np.cos(angle)",
     "plant::lever_arm_of_q5_at_an_acute_angle_by_hand"),
    ("plant", "valve_opening(command, m.dead_zone)", "valve_opening(command, m.dead_zone - 1 / 127)",
     "plant::the_first_count_that_moves_anything_is_eleven"),
    ("plant", "(i - lag) // steps", "(i - lag + 1) // steps",
     "plant::a_command_arrives_after_the_delay_and_not_a_step_earlier"),
    ("plant", "m.pump_flow / np.maximum(flow, 1e-12)", "m.pump_flow / np.maximum(2 * flow, 1e-12)",
     "paper::the_papers_coupling_test_is_marginal"),
    ("plant", "m.tau_valve_up, m.tau_valve_down", "m.tau_valve_down, m.tau_valve_up",
     "plant::an_idle_joint_takes_four_times_as_long_as_a_moving_one"),
    ("plant", "q + dt * speed / lever_arm(m, q)", "q + dt * speed * lever_arm(m, q)",
     "plant::the_plant_is_its_equations"),
    ("plant", "spool > 0, up, down", "spool > 0, down, up", "plant::the_plant_is_its_equations"),
    ("plant", "(q >= q_max) & (speed > 0)", "(q >= q_max) & (speed < 0)",
     "plant::stops_hold_and_let_go"),
    ("plant", "valve_opening(machine.pwm_limit / PWM_MAX, machine.dead_zone)", "machine.pwm_limit / PWM_MAX",
     "plant::speed_limits_are_where_the_plant_settles_at_the_command_limit"),
    # excitation and recordings
    ("excitation", "* (-1.0) ** turns", "* 1.0**turns",
     "excitation::valves_are_held_barely_open_and_moved_off_from_there"),
    ("excitation", "amplitude = rng.uniform(machine.dead_zone, machine.pwm_limit / PWM_MAX)",
     "amplitude = rng.uniform(0, machine.pwm_limit / PWM_MAX)",
     "excitation::sines_have_amplitudes_between_dead_zone_and_limit_and_random_frequencies"),
    ("excitation", "machine.dead_zone + BARELY", "1.7 * machine.dead_zone",
     "excitation::valves_with_another_dead_zone_or_none_are_held_barely_open_too"),
    # history, nets: windows and normalisation
    ("actuator", "result[..., 2, :-1] = history[..., 2, 1:]", "result[..., 2, 1:] = history[..., 2, :-1]",
     "actuator::a_history_by_hand"),
    ("actuator", "<= self.dead_zone).all", "<= 0).all",
     "actuator::commands_within_the_dead_zone_that_nets_know_move_nothing_that_stood_still"),
    ("actuator", "valve_opening(u, dead_zone)\n    scaled", "u\n    scaled",
     "actuator::what_nets_see_of_a_command_by_hand"),
    ("actuator", "by[..., 2, :] *= mu_law_derivative(history[..., 2, :], self.dead_zone)", "pass",
     "actuator::the_slope_of_nets_that_know_a_dead_zone_is_a_difference"),
    ("actuator", "result[..., 0, -1] = q", "result[..., 0, 0] = q", "actuator::a_history_by_hand"),
    ("actuator", 'np.einsum("ni,nih->nh", self.input_mean, scaled)',
     'np.einsum("ni,nih->nh", np.roll(self.input_mean, 1, 0), scaled)',
     "actuator::prediction_against_a_loop_in_double_precision"),
    ("actuator", "w1 / self.input_scale[..., None]", "w1 * self.input_scale[..., None]",
     "actuator::prediction_against_a_loop_in_double_precision"),
    ("actuator", "low + (high - low) * fraction", "low + high * fraction",
     "actuator::prediction_against_a_loop_in_double_precision"),
    ("actuator", "q + predicted / self.rate, q", "q + predicted * self.rate, q",
     "actuator::a_step_of_the_simulation_by_hand"),
    ("fitting", "np.arange(before, length - after, step)", "np.arange(before, length, step)",
     "fitting::windows_never_cross_recordings"),
    ("fitting", "np.diff(whole.q, axis=0, append=0)", "np.diff(whole.q, axis=0, prepend=0)",
     "scores::one_step_is_against_what_the_nets_are_fitted_to_by_hand"),
    ("scores", "recording.u[rows - 1]", "recording.u[rows]",
     "scores::a_free_run_sees_the_past_of_the_log_and_then_only_itself"),
    ("actuator", "[self.joints.index(name) for name in joints]",
     "sorted(self.joints.index(name) for name in joints)",
     "actuator::selected_nets_are_the_same_nets_in_another_order"),
    # logs
    ("logs", 'held = np.searchsorted(time, grid + 1e-6, side="right") - 1',
     'held = np.searchsorted(time, grid - 1e-6, side="left")', "logs::a_jittering_log_by_hand"),
    ("logs", "np.repeat(q[:1], samples - 1, axis=0), q]", "q, np.repeat(q[-1:], samples - 1, axis=0)]",
     "logs::velocity_of_a_recording_by_hand"),
    ("logs", "unknown = samples - 1 if part", "unknown = samples - 2 if part",
     "logs::a_joint_in_motion_behind_a_gap_is_never_taken_to_rest"),
    ("policy", "np.where(moves, 0, memory + 1)", "memory + 1",
     "policy::valves_close_when_the_tool_was_to_stand_for_two_seconds"),
    # the task
    ("machine", "np.sqrt(np.add.reduce(vectors * vectors, axis=-1))",
     "np.add.reduce(vectors * vectors, axis=-1)", "env::reward_by_hand"),
    ("env", "np.asarray(lowest < machine.ground)", "np.asarray(lowest <= machine.ground)",
     "env::ground_is_below_not_at"),
    ("observation", "u[..., machine.driven] = ", "u[..., : len(machine.driven)] = ",
     "observation::to_command_by_hand"),
    ("observation", "np.asarray(np.clip(action, -1.0, 1.0))", "np.tanh(action)",
     "observation::to_command_by_hand"),
    ("observation", "-1.0, 1.0) * dead + action * beyond", "-1.0, 1.0) * 0 + action * (beyond + dead)",
     "observation::to_command_by_hand"),
    ("observation", "through * (dead / COMPENSATION_RANGE)", "through * dead",
     "observation::commands_rise_with_actions_by_their_slope"),
    ("observation", "history.take(machine.driven, axis=-3)",
     "history.take(machine.driven, axis=-3)[..., ::-1]",
     "observation::observation_by_hand"),
    ("observation", "s = x / radius, sign * y / radius", "s = x / radius, -sign * y / radius",
     "observation::observation_by_hand"),
    ("observation", "(middle[j], angle[j] * each", "(middle[j - 1], angle[j] * each",
     "observation::scale_belongs_to_uniform_values_over_the_ranges"),
    ("observation", "rate[j] * each, share", "angle[j] * each, share",
     "observation::scale_belongs_to_uniform_values_over_the_ranges"),
    ("observation", "/ 12**0.5, machine.q_dot_max", "/ 13**0.5, machine.q_dot_max",
     "observation::scale_belongs_to_uniform_values_over_the_ranges"),
    ("observation", "machine.q_dot_max / 3**0.5", "machine.q_dot_max / 4**0.5",
     "observation::scale_belongs_to_uniform_values_over_the_ranges"),
    ("observation", "np.float32(2.0**-15 * largest)", "np.float32(2.0**-16 * largest)",
     "observation::noise_is_uniform_within_five_percent_and_fresh_on_what_is_sensed"),
    ("observation", "noise * sensed", "noise * scale[3 : 3 + len(sensed)]",
     "observation::noise_is_uniform_within_five_percent_and_fresh_on_what_is_sensed"),
    ("observation", "error = v_goal - v_tool", "error = v_goal + v_tool",
     "observation::the_tool_velocity_counts_against_the_goal"),
    ("observation", "np.exp(-machine.dt / INTEGRAL_TIME)", "np.exp(-INTEGRAL_TIME / machine.dt)",
     "observation::lag_by_hand"),
    ("env", "np.clip(moved, low[driven], high[driven])", "np.clip(moved, low[driven], np.inf)",
     "env::joint_limits_hold"),
    ("env", "moved = q[..., driven] + net", "moved = q[..., driven] - net",
     "env::transition_on_nets_by_hand"),
    ("env", "np.where(end, 0.0, rewards)", "rewards", "env::poses_in_the_ground_end_at_once_without_reward"),
    ("env", "round(config.episode_s * machine.rate)) & ~end", "round(config.episode_s * machine.rate))",
     "env::ground_and_time_limit_are_never_both"),
    ("environments", "observation = observation.copy()", "pass",
     "env::final_obs_is_the_end_of_the_old_episode"),
    ("env", "a[rows] = b\n", "a[: len(b)] = b\n", "env::merge_replaces_whole_rows_and_nothing_else"),
    ("env", "kind < config.zero_goals + config.axis_goals", "kind < config.axis_goals",
     "env::goals_have_the_configured_shares_speeds_and_directions"),
    ("env", "len(machine.driven) * machine.pwm_limit / PWM_MAX", "len(machine.driven)",
     "paper::without_a_valve_cost_the_reward_is_eq2_alone"),
    # the classical way
    ("jacobian", "(W if as_printed else 1 / W)", "(1 / W if as_printed else W)",
     "jacobian::dls_is_stationary_and_the_printed_form_is_not"),
    ("jacobian", "J / W[..., None, :]", "J * W[..., None, :]", "jacobian::dls_by_hand"),
    ("jacobian", "+ np.asarray(damping)[", "- np.asarray(damping)[",
     "jacobian::dls_solves_the_augmented_least_squares"),
    ("jacobian", "(2 * q - high - low)", "(high + low - 2 * q)",
     "jacobian::limit_gradient_is_the_slope_of_chan_and_dubeys_function"),
    ("jacobian", "gradient * np.asarray(q_dot) > 0", "gradient * np.asarray(q_dot) < 0",
     "jacobian::limit_weights_act_only_towards_the_limit"),
    ("jacobian", "/ w0) ** 2", "/ w0)", "jacobian::damping_by_hand_and_without_a_jump"),
    ("jacobian", "(seen.v_goal - seen.v_tool)", "(seen.v_tool - seen.v_goal)", "jacobian::rates_are_eq3"),
    ("jacobian", '"q_dot_up")[driven], m.column("q_dot_down")', '"q_dot_down")[driven], m.column("q_dot_up")',
     "jacobian::the_rate_clip_slows_down_in_the_same_direction"),
    ("jacobian", "rate / np.maximum(1.0, excess)", "np.clip(rate, -fastest, fastest)",
     "jacobian::the_rate_clip_slows_down_in_the_same_direction"),
    ("jacobian", "np.where(winding, 0.0,", "np.where(~winding, 0.0,",
     "jacobian::the_integral_and_the_derivative_by_hand"),
    ("jacobian", "(m.dead_zone + (1 - m.dead_zone) * size)", "size",
     "jacobian::the_first_tick_of_a_p_controller_by_hand"),
    ("jacobian", "part * self.velocity[j, row + 1]", "part * self.velocity[j - 1, row + 1]",
     "jacobian::the_map_keeps_the_joints_apart"),
    # derivatives of the simulation
    ("adjoint", "before[..., :2, 1:] += past[..., :2, :-1]", "before[..., :2, :-1] += past[..., :2, 1:]",
     "adjoint::gradients_are_finite_differences_of_the_simulation"),
    ("adjoint", "past[..., 1, -1:] * window", "past[..., 1, -1:]",
     "adjoint::gradients_are_finite_differences_of_the_simulation"),
    ("adjoint", "angle * np.float32(machine.dt) + by_velocity[t]", "angle + by_velocity[t]",
     "adjoint::gradients_are_finite_differences_of_the_simulation"),
    ("adjoint", "before[..., 2, 0] = 0", "pass",
     "adjoint::gradients_are_finite_differences_of_the_simulation"),
    ("adjoint", "np.float32(gamma) * ~rollout", "1.0 * ~rollout",
     "adjoint::gradients_are_finite_differences_of_the_simulation"),
    ("adjoint", "np.float32(gamma) * ~rollout.ended[t, :, None]", "np.float32(gamma)",
     "adjoint::nothing_is_earned_beyond_the_end_of_an_episode_or_by_another_environment"),
    ("adjoint", "counted * np.float32(decay * machine.dt)", "counted * np.float32(machine.dt)",
     "adjoint::the_cost_of_staying_behind_is_in_it"),
    ("observation", "/ 2 - 1\n", "/ 2\n", "observation::angles_are_told_by_all_samples"),
    ("env", "append_command(state.motion[", "append_command(state.history[",
     "env::what_encoders_say_moves_no_simulated_arm"),
    ("adjoint", "np.float32(gamma * decay) * ~rollout.ended[t, :, None]", "np.float32(gamma * decay)",
     "adjoint::nothing_is_earned_beyond_the_end_of_an_episode_or_by_another_environment"),
    ("adjoint", "+ turn) * by_action[t]", "+ turn)",
     "adjoint::gradients_are_finite_differences_of_the_simulation"),
    ("adjoint", "- cost[t] + turn", "+ cost[t] + turn", "adjoint::the_cost_of_moving_a_valve_is_in_it"),
    ("adjoint", "* (1 + size) ** 2", "* (1 + size)", "adjoint::one_tick_by_hand"),
    ("adjoint", "[..., 0, :] * free", "[..., 0, :]", "adjoint::a_joint_at_its_stop_gains_nothing_by_pushing"),
    ("actuator", "fraction * (1 - fraction)", "fraction", "adjoint::one_tick_by_hand"),
    ("actuator", "* (first > 0)", "", "adjoint::gradients_are_finite_differences_of_the_simulation"),
    # policy and PPO
    ("policy", "np.where(x > 0, x, np.expm1(np.minimum(x, 0)))", "np.maximum(x, 0)", "policy::act_by_hand"),
    ("policy", "action: Array = x @ w + b", "action: Array = x @ w", "policy::act_by_hand"),
    ("ppo", "gamma * next_values - values", "gamma * next_values + values", "ppo::gae_by_hand"),
    ("ppo", "gae_lambda * (1 - ended[t]) * later", "gae_lambda * later",
     "ppo::gae_is_the_mean_of_n_step_returns"),
    ("ppo", 'info["final_obs"][truncated]', "following[truncated]",
     "ppo::collected_advantages_use_the_right_last_observations"),
    ("ppo", "torch.where(ended > 0, tails, following)", "following",
     "ppo::collected_advantages_use_the_right_last_observations"),
    ("ppo", "[values[1:], self.agent.value(self.observation)[None]]", "[values[1:], values[-1:]]",
     "ppo::collected_advantages_use_the_right_last_observations"),
    ("ppo", "gae(rewards * (1 - c.gamma)", "gae(rewards",
     "ppo::collected_advantages_use_the_right_last_observations"),
    ("ppo", '"return": advantages + values', '"return": advantages',
     "ppo::collected_advantages_use_the_right_last_observations"),
    ("ppo", "ratio = torch.exp(new - old)", "ratio = torch.exp(old - new)", "ppo::policy_loss_by_hand"),
    ("ppo", "torch.min(ratio * advantages", "torch.max(ratio * advantages", "ppo::policy_loss_by_hand"),
    ("ppo", "torch.clamp(ratio, 1 - clip, 1 + clip)", "torch.clamp(ratio, 1 + clip, 1 + clip)",
     "ppo::policy_loss_by_hand"),
    ("ppo", "- log_std.sum() - 0.5", "+ log_std.sum() - 0.5", "ppo::log_probability_is_that_of_torch"),
    ("ppo", "nn.ELU(inplace=True)]", "nn.ReLU()]", "ppo::the_nets_are_those_of_the_paper"),
    # sequences, figures of merit
    ("sequences", "_along(machine, np.eye(3)[i])", "_along(machine, np.eye(3)[0])",
     "sequences::axis_sequences_move_along_one_axis_and_turn_round"),
    ("sequences", "table[c][rows][at - 1]", "table[c][rows][at % len(rows)]",
     "sequences::commands_are_held_until_the_next_row"),
    ("sequences", "good &= inside & slow & near &", "good &= inside & slow &",
     "sequences::feasible_refuses_a_tool_that_stays_behind"),
    ("metrics", "np.sum(away * direction, -1, keepdims=True) * direction", "0 * direction",
     "metrics::line_distance_of_a_hand_worked_drift"),
    ("metrics", "np.where(anew & ~first, before, anchor)", "np.where(anew & ~first, start, anchor)",
     "metrics::line_distance_starts_a_new_line_when_the_direction_turns"),
    ("metrics", "axis=0) * machine.rate**2", "axis=0) * machine.rate", "metrics::metrics_by_hand"),
    ("metrics", "drift.max(axis=0)", "drift.mean(axis=0)",
     "metrics::drift_is_the_largest_and_the_mean_distance_from_the_line"),
    ("metrics", "prepend=0 * trace.u[:1]", "", "metrics::metrics_by_hand"),
    ("metrics", "np.sqrt(np.mean(error**2, axis=0))", "np.mean(error, axis=0)", "metrics::metrics_by_hand"),
    ("experiments", "trace.q_measured[:, i]", "trace.q[:, i]",
     "paper::a_driven_log_is_what_encoders_and_valves_said"),
    ("figures", "trace.p_tool[:, run] - first", "trace.p_tool[:, run]",
     "paper::figure_6_runs_every_controller_and_shows_its_panels"),
    ("figures", "t.q_dot[:, run, machine.driven]", "t.q_dot[:, run, 1:]",
     "paper::figure_6_runs_every_controller_and_shows_its_panels"),
    # the bus
    ("gate", "np.maximum(last, 0) + SLEW", "last + SLEW", "gate::the_gate_is_what_its_promises_say"),
    ("wishes", "round(1e4 * v)", "int(1e4 * v)", "hw::wishes_are_rounded_not_cut"),
    ("wishes", "expo * s**3", "expo * s**2", "hw::axes_are_shaped_evenly_to_both_sides"),
    ("wishes", "asked * chosen * self.counts", "asked * self.counts",
     "hw::jog_moves_one_joint_the_way_the_stick_points"),
    ("wishes", "ready and not self.pressed", "ready", "hw::a_script_waits_presses_plays_and_ends"),
    ("bus", "(4 - (frame.data[0] >> 2 & 3))", "4", "hw::sdo_reads_small_objects_and_skips_foreign_answers"),
    ("simulator", "int(data[5]) - 1) % 256", "int(data[5]) - 1)",
     "hw::reward_over_the_bus_is_that_of_evaluate"),
]  # fmt: skip


def functions(code: types.CodeType) -> Iterator[tuple[str, types.CodeType]]:
    """Functions and methods of a compiled module by their qualified names, without those inside functions."""
    for part in code.co_consts:
        if isinstance(part, types.CodeType) and "<locals>" not in part.co_qualname:
            yield part.co_qualname, part
            yield from functions(part)


def function_of(module: types.ModuleType, name: str) -> types.FunctionType | None:
    """The function object of a qualified name, out of its property or decorator; None: a class body."""
    thing: Any = module
    for part in name.split("."):
        thing = vars(thing).get(part)
    for wrapper in ("func", "fget"):
        thing = getattr(thing, wrapper, thing)
    thing = inspect.unwrap(thing)
    return thing if isinstance(thing, types.FunctionType) else None


def forget() -> None:
    """What is worked out once a machine and kept with it: `observation._layout`, `kinematics._plan`."""
    for kept in ("layout", "plans"):
        BROKK_170.__dict__.pop(kept, None)


@contextmanager
def planted(name: str, right: str, wrong: str) -> Iterator[None]:
    """The package with one error in it."""
    module = importlib.import_module(f"brokk_min.{name}")
    source = inspect.getsource(module)
    if source.count(right) != 1:
        raise ValueError(
            f"{name}: expected {right!r} once in its source, got {source.count(right)} times"
        )
    before = dict(functions(compile(source, str(module.__file__), "exec")))
    after = dict(functions(compile(source.replace(right, wrong), str(module.__file__), "exec")))
    changed = [function_of(module, name) for name in before if before[name] != after[name]]
    (owner,) = filter(None, changed)
    kept, owner.__code__ = owner.__code__, after[owner.__code__.co_qualname]
    forget()
    try:
        yield
    finally:
        owner.__code__ = kept
        forget()


@cache
def copy_of(name: str) -> types.ModuleType:
    """A test file imported once more, its properties without shrinking."""
    path = Path(__file__).with_name(f"test_{name}.py")
    spec = importlib.util.spec_from_file_location(f"copy_of_test_{name}", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    loaded = settings.get_current_profile_name()
    settings.register_profile(
        "mutants",
        settings.default,
        phases=[Phase.generate],
        report_multiple_bugs=False,
        print_blob=False,
    )
    settings.load_profile("mutants")
    try:
        spec.loader.exec_module(module)
    finally:
        settings.load_profile(loaded)
    return module


def calls(test: Callable[..., object], fixtures: dict[str, object]) -> Iterator[dict[str, object]]:
    """Arguments of every case of a parametrised test."""
    axes = []
    for mark in getattr(test, "pytestmark", []):
        names = (
            [n.strip() for n in mark.args[0].split(",")]
            if isinstance(mark.args[0], str)
            else mark.args[0]
        )
        axes.append([dict(zip(names, case if len(names) > 1 else [case])) for case in mark.args[1]])
    for cases in itertools.product(*axes):
        given = {name: value for case in cases for name, value in case.items()}
        wanted = inspect.signature(test).parameters
        yield given | {name: value for name, value in fixtures.items() if name in wanted}


def test_planted_errors_are_many_and_in_every_module_that_works_out_numbers() -> None:
    assert len(PLANTED) >= 40
    numeric = "machine kinematics logs plant excitation actuator fitting scores observation env ppo"
    others = "policy jacobian sequences experiments metrics figures gate bus wishes simulator"
    assert {*numeric.split(), *others.split()} <= {module for module, *_ in PLANTED}


@pytest.mark.parametrize(("module", "right", "wrong", "test"), PLANTED, ids=lambda text: text[:40])
def test_a_planted_error_is_found(
    module: str, right: str, wrong: str, test: str, tmp_path: Path
) -> None:
    file, name = test.split("::")
    check = getattr(copy_of(file), f"test_{name}")
    with planted(module, right, wrong), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for arguments in calls(check, {"tmp_path": tmp_path}):
            try:
                check(**arguments)
            except (AssertionError, pytest.fail.Exception):
                return
    raise AssertionError(f"{test} passes with {wrong!r} for {right!r} in {module}.py")
