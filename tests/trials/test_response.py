"""What a recorded move says, checked against closed forms."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.tables import every_row

from drive_env.trials.response import _reversals, current_metrics, disturbance_metrics, oscillation, step_metrics

DT = 1e-3
TAU = 0.02
T = np.arange(0, 0.3005, DT)
FINE = np.arange(0, 0.5, 1e-5)  # fine enough for the closed forms


def first_order(t, tau=TAU):
    return 1 - np.exp(-t / tau)


def second_order(t, zeta, omega):
    omega_d = omega * np.sqrt(1 - zeta**2)
    sine = zeta / np.sqrt(1 - zeta**2) * np.sin(omega_d * t)
    return 1 - np.exp(-zeta * omega * t) * (np.cos(omega_d * t) + sine)


def sine(t, frequency, phase=0.0):
    return np.sin(2 * np.pi * frequency * t + phase)


def assert_same(a, b, scale=None):
    """Assert that all figures agree, those named in scale after division by their factor."""
    for field in fields(a):
        x = getattr(a, field.name) / (scale or {}).get(field.name, 1)
        np.testing.assert_allclose(x, getattr(b, field.name), rtol=1e-6, atol=1e-9, err_msg=field.name)


# --- step: closed forms -------------------------------------------------------------------------------------------


def test_first_order_step():
    m = step_metrics(FINE, 5 * first_order(FINE), 5.0, t_step=0.0)
    assert m.rise_time == pytest.approx(np.log(9) * TAU, rel=1e-5)  # 2.197 tau
    assert m.settling_time == pytest.approx(-np.log(0.02) * TAU, rel=1e-5)  # 3.912 tau
    assert m.iae == pytest.approx(TAU * 5, rel=1e-5)
    assert m.itae == pytest.approx(TAU**2 * 5, rel=1e-5)
    assert m.overshoot == 0
    assert m.undershoot == 0
    assert m.steady_state_error == pytest.approx(0, abs=1e-8)
    assert not m.oscillating
    assert np.isnan(m.oscillation_frequency)


@pytest.mark.parametrize("zeta", [0.2, 0.4, 0.6, 0.8])
def test_second_order_overshoot(zeta):
    m = step_metrics(FINE, second_order(FINE, zeta, omega=200.0), 1.0, t_step=0.0)
    assert m.overshoot == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=1e-4)
    assert m.undershoot == 0


def test_interpolation_makes_a_ramp_exact_on_a_coarse_grid():
    t = np.arange(0, 2.05, 0.1)
    m = step_metrics(t, np.minimum(t, 1.0), 1.0, t_step=0.0, band=0.03)
    assert m.rise_time == pytest.approx(0.8)
    assert m.settling_time == pytest.approx(0.97)
    assert m.iae == pytest.approx(0.5)


def test_rise_time_between_samples():
    m = step_metrics([0.0, 1.0, 2.0], [0.0, 0.5, 1.0], 1.0, t_step=0.0)  # 10 % at 0.2 s, 90 % at 1.8 s
    assert m.rise_time == pytest.approx(1.6)


def test_inverse_response_undershoots():
    # (1 - a s) / (1 + s tau)^2: y falls to its minimum at t* = a tau / (a + tau).
    a = 0.01
    y = 1 - (1 + FINE / TAU + a * FINE / TAU**2) * np.exp(-FINE / TAU)
    t_min = a * TAU / (a + TAU)
    depth = (1 + t_min / TAU + a * t_min / TAU**2) * np.exp(-t_min / TAU) - 1
    m = step_metrics(FINE, 3 + 2 * y, 5.0, t_step=0.0)
    assert m.undershoot == pytest.approx(depth, rel=1e-4)
    assert m.overshoot == 0


def test_steady_state_error_is_the_mean_of_the_last_tenth():
    t = np.arange(11.0)
    y = np.array([0, 9, 9, 9, 9, 9, 9, 9, 9, 8, 7.0])
    assert step_metrics(t, y, 10.0, t_step=0.0).steady_state_error == 2.5  # samples 9 and 10: (2 + 3) / 2
    assert step_metrics(t, y, 10.0, t_step=0.0, tail=0.2).steady_state_error == 2.0
    assert step_metrics(t, y, 5.0, t_step=0.0).steady_state_error == -2.5  # too high: negative


def test_errors_follow_a_moving_reference_and_the_rest_its_end():
    reference = np.minimum(FINE / 0.1, 1.0)
    m = step_metrics(FINE, reference - 0.01, reference, t_step=0.0, initial=0.0)
    assert m.iae == pytest.approx(0.01 * FINE[-1])
    assert m.itae == pytest.approx(0.01 * FINE[-1] ** 2 / 2)
    assert m.steady_state_error == pytest.approx(0.01)
    assert m.rise_time == pytest.approx(0.08)
    assert m.undershoot == pytest.approx(0.01)


# --- step: where the window begins and ends -----------------------------------------------------------------------


def test_what_happens_before_the_step_does_not_count():
    t = np.arange(-0.1, 0.3, DT)
    y = np.where(t < -DT / 2, 3 * sine(t, 50), first_order(np.maximum(t, 0)))
    after = t > -DT / 2
    early, late = step_metrics(t, y, 1.0, t_step=0.0), step_metrics(t[after], y[after], 1.0, t_step=float(t[after][0]))
    assert_same(early, late)


def test_times_count_from_the_step():
    moved = step_metrics(T + 7.0, first_order(T), 1.0, t_step=7.0)
    assert_same(moved, step_metrics(T, first_order(T), 1.0, t_step=0.0))


def test_initial_value_is_the_last_sample_not_later_than_the_step():
    m = step_metrics([0.0, 1.0, 2.0, 3.0, 4.0], [9.0, 2.0, 1.0, 4.0, 4.0], 4.0, t_step=1.0)
    assert m.undershoot == 0.5  # from 2 down to 1, of a height of 2
    m = step_metrics([0.0, 1.0, 2.0, 3.0, 4.0], [9.0, 2.0, 1.0, 4.0, 4.0], 4.0, t_step=1.5)
    assert m.undershoot == 0.5
    m = step_metrics([0.0, 1.0, 2.0, 3.0, 4.0], [9.0, 2.0, 1.0, 4.0, 4.0], 4.0, t_step=1.0, initial=0.0)
    assert m.undershoot == 0


def test_rounded_times_cost_no_sample():
    t = np.array([0.0, 0.1, 0.2, 0.3, 0.4]) - 1e-13  # 0.1 s and 0.4 s are missed by less than a rounding error
    y = np.array([0.0, 0.0, 2.0, 1.0, 1.0])
    m = step_metrics(t, y, 1.0, t_step=0.1, t_end=0.4)
    assert m.iae == pytest.approx(0.15)
    assert m.overshoot == 1


def test_rounding_is_a_billionth_of_the_whole_record_also_of_two_samples():
    m = step_metrics([0.0, 1.0], [0.0, 1.0], 1.0, t_step=-1e-13, t_end=1.0 + 1e-13)
    assert m.iae == pytest.approx(0.5)
    for times in ({"t_step": -2e-9}, {"t_step": 0.0, "t_end": 1.0 + 2e-9}):
        with pytest.raises(ValueError, match="lies outside"):
            step_metrics([0.0, 1.0], [0.0, 1.0], 1.0, **times)


def test_t_end_cuts_the_record():
    y = first_order(T) + np.where(T > 0.2005, 1.0, 0.0)  # a load step at 0.2 s
    cut = T < 0.2005
    assert np.isnan(step_metrics(T, y, 1.0, t_step=0.0).settling_time)
    assert_same(step_metrics(T, y, 1.0, t_step=0.0, t_end=0.2), step_metrics(T[cut], y[cut], 1.0, t_step=0.0))


def test_the_final_reference_is_the_one_at_t_end():
    m = step_metrics(T, first_order(T), np.where(T > 0.2005, 9.0, 1.0), t_step=0.0, t_end=0.2)
    assert m.rise_time == pytest.approx(np.log(9) * TAU, rel=1e-2)


# --- step: what never happens -------------------------------------------------------------------------------------


def test_a_response_that_never_rises():
    m = step_metrics(T, 0.5 * first_order(T), 1.0, t_step=0.0)
    assert np.isnan(m.rise_time)
    assert np.isnan(m.settling_time)
    assert m.overshoot == 0
    assert m.steady_state_error == pytest.approx(0.5, abs=1e-5)


def test_a_response_that_leaves_the_band_again_has_settled_only_afterwards():
    t = np.arange(8.0)
    y = np.array([0, 1, 1, 1.5, 1, 1, 1, 1])
    assert step_metrics(t, y, 1.0, t_step=0.0, band=0.25).settling_time == 3.5
    assert np.isnan(step_metrics(t, y, 1.0, t_step=0.0, band=0.25, t_end=3.0).settling_time)


def test_the_edge_of_the_band_is_inside():
    y = [0.0, 0.5, 0.75]
    assert step_metrics([0.0, 1.0, 2.0], y, 1.0, t_step=0.0, band=0.25).settling_time == 2
    assert np.isnan(step_metrics([0.0, 1.0, 2.0], y, 1.0, t_step=0.0, band=0.2).settling_time)


def test_ninety_percent_at_the_last_sample_is_a_rise():
    assert step_metrics([0.0, 1.0, 2.0], [0.0, 0.0, 90.0], 100.0, t_step=0.0).rise_time == pytest.approx(8 / 9)


def test_a_response_that_starts_at_the_reference_takes_no_time():
    m = step_metrics(T, np.ones_like(T), 1.0, t_step=0.0, initial=0.0)
    assert m.rise_time == 0
    assert m.settling_time == 0
    assert m.iae == 0


# --- step: symmetries ---------------------------------------------------------------------------------------------


def test_step_down_mirrors_step_up():
    y = second_order(T, 0.3, 120.0) - 0.1 * (T == 0.002)
    up, down = step_metrics(T, y, 1.0, t_step=0.0), step_metrics(T, -y, -1.0, t_step=0.0)
    assert_same(down, up, scale={"steady_state_error": -1})


@settings(max_examples=50, deadline=None)
@given(
    height=st.floats(1e-3, 1e3) | st.floats(-1e3, -1e-3),
    offset=st.floats(-100, 100),
    stretch=st.floats(0.1, 10),
    zeta=st.floats(0.1, 0.9),
)
def test_figures_scale_with_height_and_time_and_ignore_an_offset(height, offset, stretch, zeta):
    y = second_order(T, zeta, 100.0) + 0.3 * T
    unit = step_metrics(T, y, 1.0, t_step=0.0)
    scaled = step_metrics(T * stretch, offset + height * y, offset + height, t_step=0.0)
    size = abs(height)
    scale = {"rise_time": stretch, "settling_time": stretch, "steady_state_error": height, "iae": size * stretch}
    scale |= {"itae": size * stretch**2, "oscillation_frequency": 1 / stretch}
    assert_same(scaled, unit, scale)


# --- many axes ----------------------------------------------------------------------------------------------------


@pytest.fixture
def grid():
    rng = np.random.default_rng(3)
    y = second_order(T[:, None], np.array([0.1, 0.3, 0.7, 0.9]), np.array([40.0, 90.0, 200.0, 400.0]))
    y[:, 1] += 0.1 * sine(T, 120)
    return y + 0.003 * rng.normal(size=y.shape), np.array([1.0, -2.0, 3.0, 0.5])


def test_all_axes_at_once_equal_one_by_one(grid):
    y, height = grid
    step = step_metrics(T, y * height, height, t_step=0.0)
    load = disturbance_metrics(T, y * height, height, t_load=0.05)
    effort = current_metrics(y, i_max=np.abs(height))
    assert step.oscillating.tolist() == [True, True, False, False]
    for k in range(4):
        one_step = step_metrics(T, y[:, k] * height[k], height[k], t_step=0.0)
        one_load = disturbance_metrics(T, y[:, k] * height[k], height[k], t_load=0.05)
        one_effort = current_metrics(y[:, k], i_max=abs(height[k]))
        for many, one in ((step, one_step), (load, one_load), (effort, one_effort)):
            for field in fields(one):
                figure = getattr(one, field.name)
                assert figure.shape == ()
                assert figure.dtype == getattr(many, field.name).dtype
                np.testing.assert_allclose(getattr(many, field.name)[k], figure, rtol=1e-12, err_msg=field.name)


def test_a_reference_per_sample_and_axis_equals_one_per_axis(grid):
    y, height = grid
    per_axis = step_metrics(T, y * height, height, t_step=0.0)
    assert_same(step_metrics(T, y * height, np.tile(height, (T.size, 1)), t_step=0.0), per_axis)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_a_diverged_axis_is_nan_and_oscillating_and_leaves_the_others_alone(grid, poison):
    y, height = grid
    y[200:, 2] = poison
    clean = [0, 1, 3]
    for metrics in (
        lambda y, h: step_metrics(T, y, h, t_step=0.0),
        lambda y, h: disturbance_metrics(T, y, h, t_load=0.05),
        lambda y, h: current_metrics(y, i_max=np.abs(h)),
    ):
        poisoned, reference = metrics(y, height), metrics(y[:, clean], height[clean])
        for field in fields(reference):
            figure = getattr(poisoned, field.name)
            assert figure[2] if field.name == "oscillating" else np.isnan(figure[2]), field.name
            np.testing.assert_allclose(figure[clean], getattr(reference, field.name), rtol=1e-12)


def test_an_axis_that_diverged_before_the_step_has_no_figures():
    y = first_order(T)
    y[3] = np.nan
    m = step_metrics(T, y, 1.0, t_step=0.1)
    assert m.oscillating
    assert np.isnan(m.overshoot)
    rings, frequency = oscillation(T, y, amplitude=0.05)
    assert rings
    assert np.isnan(frequency)


def test_numbers_too_large_to_square_give_nan_not_inf():
    assert np.isnan(current_metrics([1e200, -1e200], i_max=1.0).rms)


# --- disturbance --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
def test_disturbance_dip_and_recovery(sign):
    # y - y_0 = -(t / tau) exp(1 - t / tau): a dip of 1 at tau, an area of e tau, back within 10 % at 4.8897 tau.
    t = np.arange(-0.1, 0.5, 1e-5)
    s = np.maximum(t, 0) / TAU
    m = disturbance_metrics(t, 5 - sign * 2 * s * np.exp(1 - s), 5.0, t_load=0.0)
    assert m.dip == pytest.approx(2)
    assert m.recovery_time == pytest.approx(4.88972 * TAU, rel=1e-5)
    assert m.iae == pytest.approx(2 * np.e * TAU, rel=1e-5)


def test_dip_counts_from_the_value_before_and_iae_from_the_reference():
    y = np.where(T > 0.1005, 9.0, 10.0)  # a lasting droop of 1 after the load step, an error of 2 before
    m = disturbance_metrics(T, y, 12.0, t_load=0.1)
    assert m.dip == 1
    assert np.isnan(m.recovery_time)
    assert m.iae == pytest.approx(3 * 0.2 - DT / 2)


def test_a_dip_before_the_load_step_or_after_t_end_does_not_count():
    y = np.where((T < 0.05) | (T > 0.2005), 0.0, 10.0)
    m = disturbance_metrics(T, y, 10.0, t_load=0.1, t_end=0.2)
    assert m.dip == 0
    assert m.recovery_time == 0
    assert m.iae == 0


def test_recovery_time_counts_from_the_load_step():
    s = np.maximum(T - 0.1, 0) / TAU
    assert disturbance_metrics(T, -s * np.exp(1 - s), 0.0, t_load=0.1).recovery_time == pytest.approx(
        4.89 * TAU, rel=0.01
    )


def test_recovery_band_is_a_fraction_of_the_dip():
    t = np.arange(6.0)
    y = [0.0, -1.0, -0.75, -0.5, -0.25, 0.0]
    assert disturbance_metrics(t, y, 0.0, t_load=0.0, band=0.25).recovery_time == 4
    assert disturbance_metrics(t, y, 0.0, t_load=0.0, band=0.5).recovery_time == 3


# --- current ------------------------------------------------------------------------------------------------------


def test_current_of_a_sine():
    t = np.arange(1000) * DT
    m = current_metrics(-3 * sine(t, 10, phase=np.pi / 2), i_max=5.0)
    assert m.peak == pytest.approx(3)
    assert m.rms == pytest.approx(3 / np.sqrt(2))
    assert m.saturation_share == 0


def test_peak_current_counts_either_sign():
    assert current_metrics([1.0, -4.0, 2.0], i_max=5.0).peak == 4
    assert current_metrics([1.0, 4.0, -2.0], i_max=5.0).peak == 4


def test_saturation_counts_both_signs_and_the_edge():
    i = [0.0, 7.5, -7.5, 7.0, -10.0, 11.0, 2.0, 0.0]
    assert current_metrics(i, i_max=10.0, tol=0.25).saturation_share == 4 / 8
    assert current_metrics(i, i_max=10.0).saturation_share == 2 / 8


# --- reversals ----------------------------------------------------------------------------------------------------
def test_a_turn_counts_in_either_direction_and_the_first_move_is_none():
    zigzag = np.array([0.0, 1.0, 0.2, 1.0, 0.1, 0.9])
    columns = np.stack([zigzag, -zigzag, np.linspace(0, 1, 6), 0.4 * zigzag], axis=-1)
    assert _reversals(columns, np.full(4, 0.5)).tolist() == [4, 4, 0, 0]


# --- oscillation --------------------------------------------------------------------------------------------------

PHASES = np.linspace(0, 2 * np.pi, 16, endpoint=False)
DURATIONS = (0.15, 0.3, 0.7, 1.0)


def record(duration):
    return np.arange(round(duration / DT) + 1) * DT


@pytest.mark.every(2)
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("duration", DURATIONS)
def test_a_limit_cycle_of_five_percent_is_found_from_5_hz_to_450_hz(duration, noise):
    t = record(duration)[:, None]
    rng = np.random.default_rng(4)
    lowest = max(5.0, 3.5 / duration)
    for f in (lowest, 1.2 * lowest, 2 * lowest, 50.0, 100.0, 125.0, 200.0, 250.0, 1000 / 3, 400.0, 449.0, 450.0):
        y = first_order(t, 0.05 * duration) + 0.05 * sine(t, f, PHASES)
        y += noise * rng.normal(size=y.shape)
        m = step_metrics(t[:, 0], 20 * y, 20.0, t_step=0.0, initial=0.0)
        assert m.oscillating.all(), f
        np.testing.assert_allclose(m.oscillation_frequency, f, atol=0.25 / duration)


@pytest.mark.parametrize("duration", DURATIONS)
def test_a_growing_oscillation_is_found(duration):
    t = record(duration)[:, None]
    for f in (5 / duration, 60.0, 300.0, 450.0):
        growth = 0.5 * 20 ** (t / duration - 1)
        assert step_metrics(t[:, 0], 1 - growth * sine(t, f, PHASES), 1.0, t_step=0.0, initial=0.0).oscillating.all()


@pytest.mark.parametrize("duration", DURATIONS)
def test_a_ringing_that_dies_out_into_a_limit_cycle_is_found(duration):
    t = record(duration)
    y = second_order(t, 0.1, 2 * np.pi * 20 / duration) + 0.05 * sine(t, 20 / duration)
    assert step_metrics(t, y, 1.0, t_step=0.0).oscillating


def steady_limit_cycle_beside(trend):
    t = record(0.5)
    return oscillation(t, trend(t) + 0.06 * sine(t, 40), amplitude=0.05)


@pytest.mark.parametrize("trend", [lambda t: 7.0 + 0 * t, lambda t: -3 * t, lambda t: np.exp(-t / 0.2)])
def test_an_offset_a_ramp_or_a_tail_does_not_hide_a_limit_cycle(trend):
    rings, frequency = steady_limit_cycle_beside(trend)
    assert rings
    assert frequency == pytest.approx(40, abs=1)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("duration", DURATIONS)
def test_what_is_no_oscillation(duration, noise):
    t = record(duration)[:, None]
    rng = np.random.default_rng(5)
    scale = np.geomspace(0.01, 5, 40) * duration
    calm = {
        "noise alone": np.ones((t.size, 500)),
        "first order, also far too slow": first_order(t, scale),
        "well damped": np.hstack([second_order(t, zeta, 1 / scale) for zeta in (0.5, 0.7, 0.9)]),
        "ramp into the reference": np.minimum(t / scale, 1.0),
        "damping 0.1, died out": second_order(t, 0.1, 2 * np.pi * np.geomspace(6.3, 60, 40) / duration),
        "small limit cycle": 1 + 0.02 * sine(t, 50.0, PHASES),
    }
    for name, y in calm.items():
        noisy = y + noise * rng.normal(size=y.shape)
        m = step_metrics(t[:, 0], noisy, 1.0, t_step=0.0, initial=0.0)
        assert not m.oscillating.any(), name
        assert np.isnan(m.oscillation_frequency).all(), name


def test_encoder_steps_are_no_oscillation():
    rng = np.random.default_rng(6)
    toggling = 1 + 0.01 * rng.choice([-1.0, 1.0], size=(301, 500))
    assert not step_metrics(T, toggling, 1.0, t_step=0.0, initial=0.0).oscillating.any()


def test_one_late_spike_is_no_oscillation():
    x = np.zeros(301)
    x[250:260] = 1.0
    assert not oscillation(T, x, amplitude=0.05)[0]


def test_spikes_between_rest_are_noise_not_ringing():
    x = np.zeros(301)
    x[::50] = 0.1
    assert not oscillation(T, x, amplitude=0.05)[0]


def test_a_ringing_that_has_died_before_the_end_is_no_oscillation():
    x = np.where(T < 0.17, sine(T, 50), np.minimum(T - 0.17, 0.0))
    assert not oscillation(T, x + np.where(T > 0.25, 1.0, 0.0), amplitude=0.05)[0]


def test_a_ringing_transient_and_a_late_ramp_are_no_oscillation():
    x = np.where(T < 0.05, sine(T, 100), np.maximum(T - 0.2, 0.0) * 10)
    assert not oscillation(T, x, amplitude=0.05)[0]


def test_a_ringing_that_has_fallen_below_the_amplitude_is_no_oscillation():
    assert not oscillation(T, np.where(T < 0.15, 0.036, 0.031) * sine(T, 40), amplitude=0.05)[0]
    assert oscillation(T, 0.036 * sine(T, 40), amplitude=0.05)[0]


def test_oscillation_of_a_current_has_an_amplitude_in_ampere():
    i = 2.0 + 0.3 * sine(T, 80)
    rings, frequency = oscillation(T, np.stack([i, i], axis=1), amplitude=np.array([0.2, 0.5]))
    assert rings.tolist() == [True, False]
    assert frequency[0] == pytest.approx(80, abs=0.5)
    assert np.isnan(frequency[1])


@pytest.mark.parametrize("n", [1, 2, 3, 5, 10])
def test_a_record_too_short_to_tell_is_no_oscillation(n):
    assert not oscillation(np.arange(n) * DT, np.arange(n) % 2 * 1.0, amplitude=2.0)[0]


# --- errors -------------------------------------------------------------------------------------------------------

Y = first_order(T)
NO_STEP = "step height is zero on 1 of 1 axes (reference equals initial); overshoot needs a step: leave these axes out"
SHAPES = "give t as (n,) and the signal as (n,) or (n, num_axes)"
IN_RECORD = "lies outside the record of 0 s to 0.3 s; choose"
FRACTION = "must lie in (0, 1); give a fraction, 0.02 for 2 %"


@every_row(
    ("call", "text"),
    [
        (lambda: step_metrics([0, 1, 1], [0, 1, 1], 1, t_step=0), "t is not strictly increasing: t[1]=1 s, t[2]=1 s;"),
        (lambda: step_metrics([0, 0, 1], [0, 1, 1], 1, t_step=0), "t is not strictly increasing: t[0]=0 s, t[1]=0 s;"),
        (lambda: step_metrics([0, 2, 1], [0, 1, 1], 1, t_step=0), "t[2]=1 s; sort the record and drop repeated"),
        (
            lambda: step_metrics(T, Y[:-1], 1, t_step=0),
            f"t of shape (301,) does not fit a signal of shape (300,); {SHAPES}",
        ),
        (
            lambda: step_metrics(Y[:, None], Y, 1, t_step=0),
            f"t of shape (301, 1) does not fit a signal of shape (301,); {SHAPES}",
        ),
        (lambda: step_metrics(T, 1.0, 1, t_step=0), "signal has shape (); give at least one sample as (n,)"),
        (lambda: step_metrics([], [], 1, t_step=0), "signal has shape (0,); give at least one sample as (n,)"),
        (
            lambda: step_metrics(T, Y, [1, 2], t_step=0),
            "reference of shape (2,) does not fit a signal of shape (301,);",
        ),
        (lambda: step_metrics(T, Y, [1, 2], t_step=0), "give one number or an array of shape ()"),
        (
            lambda: step_metrics(T, np.tile(Y[:, None], 3), [1, 2], t_step=0),
            "reference of shape (2,) does not fit a signal of shape (301, 3); give one number or an array of shape (3,",
        ),
        (lambda: step_metrics(T, Y, 1, t_step=0, initial=[0]), "initial of shape (1,) does not fit"),
        (lambda: step_metrics(T, Y, 0, t_step=0), NO_STEP),
        (lambda: step_metrics(T, Y, 0, t_step=0), "or give initial="),
        (lambda: step_metrics(T, Y, 1, t_step=-0.1), f"t_step=-0.1 s {IN_RECORD} t_step within it"),
        (lambda: step_metrics(T, Y, 1, t_step=0.3), f"t_step=0.3 s {IN_RECORD} t_step within it, before its last"),
        (lambda: step_metrics(T, Y, 1, t_step=np.nan), f"t_step=nan s {IN_RECORD}"),
        (lambda: disturbance_metrics(T, Y, 1, t_load=0.4), f"t_load=0.4 s {IN_RECORD} t_load within it"),
        (lambda: step_metrics(T, Y, 1, t_step=0, t_end=1), "t_end=1 s lies outside t_step=0 s to 0.3 s; choose t_end"),
        (lambda: step_metrics(T, Y, 1, t_step=0.1, t_end=0.1), "t_end=0.1 s lies outside t_step=0.1 s to 0.3 s"),
        (
            lambda: step_metrics(T, Y, 1, t_step=0.1001, t_end=0.1009),
            "empty window: t_step=0.1001 s to t_end=0.1009 s holds 0 samples of at least 2",
        ),
        (lambda: step_metrics(T, Y, 1, t_step=0.1, t_end=0.1005), "holds 1 samples of at least 2; widen it or sample"),
        (lambda: step_metrics(T, Y, 1, t_step=0, band=0), f"band=0 {FRACTION}"),
        (lambda: step_metrics(T, Y, 1, t_step=0, band=1), f"band=1 {FRACTION}"),
        (lambda: step_metrics(T, Y, 1, t_step=0, tail=2), f"tail=2 {FRACTION}"),
        (lambda: step_metrics(T, Y, 1, t_step=0, oscillation_amplitude=0), f"oscillation_amplitude=0 {FRACTION}"),
        (lambda: disturbance_metrics(T, Y, 1, t_load=0, band=-1), f"band=-1 {FRACTION}"),
        (lambda: current_metrics(Y, i_max=1, tol=1), f"tol=1 {FRACTION}"),
        (lambda: current_metrics(Y, i_max=0), "i_max=0 A must be positive; give the current limit as a magnitude"),
        (lambda: current_metrics(Y, i_max=np.nan), "i_max=nan A must be positive"),
        (lambda: current_metrics([], i_max=1), "i has shape (0,); give at least one sample as (n,) or (n, num_axes)"),
        (lambda: oscillation(T, Y, amplitude=-1), "amplitude=-1 must be positive; give what still counts as steady"),
        (lambda: oscillation(T, Y, amplitude=0), "amplitude=0 must be positive; give what still counts as steady"),
        (lambda: oscillation(T, Y, amplitude=[1.0]), "amplitude of shape (1,) does not fit a signal of shape (301,)"),
    ],
)
def test_errors_say_what_to_do(call, text):
    with pytest.raises(ValueError) as error:
        call()
    assert text in str(error.value)


def test_one_axis_without_a_step_is_named_by_number():
    with pytest.raises(ValueError, match="step height is zero on 1 of 3 axes"):
        step_metrics(T, np.zeros((T.size, 3)), [1.0, 0.0, -2.0], t_step=0.0)
