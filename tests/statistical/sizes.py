"""What every statistical test draws and claims, and how seldom the suite may fail without fault.

This is the one place to make the suite longer or shorter. The number of claims is the number of
p values that Holm's rule holds to `LEVEL` together, see `tests.claims`. A control has to be seen
at the strictest level: 150 intervals of half the width, for example, have p < 1e-6 in all but one
of a million runs.
"""

from __future__ import annotations

from tests.claims import Part

# Probability at most that a suite without fault fails.
LEVEL = 0.01
# Of all generators, unless LMSHEALTH_SEED is set.
SEED = 20260301


def _both(kind: str) -> tuple[str, str]:
    """Claim natural frequency and damping ratio from a kind of record."""
    return f"f, {kind}", f"ζ, {kind}"


TESTS = {
    # Readings of one log.
    "test_lines_are_called_no_oftener_than_declared": Part(800, ("false alarms",), control=60),
    "test_slopes_over_velocity_cover": Part(80, ("slopes", "said to grow")),
    # Identification.
    "test_intervals_from_one_record_cover": Part(200, _both("one record")),
    "test_intervals_from_short_moves_cover": Part(150, _both("short moves")),
    "test_intervals_from_means_over_parts_cover": Part(150, _both("parts"), control=100),
    "test_intervals_of_three_modes_in_three_channels_cover": Part(50, _both("three modes")),
    "test_intervals_cover_where_floors_share_the_force": Part(150, _both("common floor")),
    "test_intervals_of_joint_sources_cover": Part(300, _both("joint sources"), control=150),
    "test_intervals_from_stops_cover": Part(300, _both("stops")),
    "test_intervals_from_whole_periods_cover": Part(150, _both("whole periods")),
    "test_intervals_from_driven_records_cover": Part(60, _both("records")),
    # Tracking.
    "test_errors_of_the_true_setting_are_as_large_as_it_says": Part(
        800, ("ln f", "ln ζ", "drift", "innovations")
    ),
    "test_intervals_of_the_tracker_cover": Part(
        160,
        tuple(
            f"{what}, {how}"
            for what in ("ln f", "ln ζ", "drift")
            for how in ("average of settings", "as published")
        ),
    ),
    "test_a_second_source_does_no_harm": Part(60, ("drift, two sources",)),
    "test_modes_that_cross_are_not_swapped": Part(30, ("swaps, named by order", "swaps, unnamed")),
    "test_healthy_lives_raise_no_alarms": Part(100, ("alarms",), control=10),
    "test_drifts_of_damaged_lives_cover": Part(100, ("drift, damaged lives",)),
    # Lives of another plant, by kind.
    "test_health_of_lives_that_wear_is_held": Part(12, ("preload that wears",)),
    "test_a_mode_that_moves_alone_is_named": Part(
        8, ("mode alone, named", "mode alone, no part degraded")
    ),
    "test_machines_that_stay_raise_no_alarm": Part(8, ("no alarm, by kind",)),
    # Laws and the remaining life.
    "test_losses_by_laws_are_calibrated": Part(150, ("loss by the law", "health now")),
    "test_health_off_its_law_is_calibrated": Part(250, ("health now, off its law",)),
    "test_ranks_of_whole_lives_are_uniform": Part(
        40,
        (
            "guide preload changes",
            "mount stiffness changes",
            "guide preload now",
            "mount stiffness now",
            "guide preload off its law",
            "remaining, guide preload",
            "remaining, mount stiffness",
            "remaining, first",
            "days left",
        ),
    ),
    "test_usage_covers_what_comes": Part(400, ("twenty weeks", "three weeks")),
    "test_young_machines_are_told_right_by_their_fleet": Part(24, ("remaining life",)),
    # Planning.
    "test_a_test_has_the_power_that_was_planned": Part(
        20_000,
        (
            "power, two modes",
            "false alarms, two modes",
            "power, one mode",
            "false alarms, one mode",
        ),
    ),
    "test_the_posterior_has_the_power_that_was_planned": Part(
        200, ("power, posterior", "false alarms, posterior")
    ),
}
