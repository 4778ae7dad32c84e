"""Constants that decide what a track publishes."""

# Priors. Rates and walks of a mode are per life.
LN_F_STD = 0.1
LN_ZETA_STD = 1.0
DAMPING_WALK = 0.5
BIAS_STD = (0.005, 0.2)
COVARIATE_STD = 0.001
# Standard deviations of the jumps of ln f and ln ζ: of a loosened bolt or a crash; of grease; of
# the loop's poles; of a sensor that was moved or calibrated anew; of an overhaul.
JUMP_STD: dict[str, tuple[float, float]] = {
    "step": (0.03, 0.3),
    "regreasing": (0.0, 0.3),
    "servo": (0.01, 0.2),
    "sensor": (0.005, 0.2),
    "reset": (0.05, 0.5),
}
FALSE_ALARM_PROBABILITY = 0.01
