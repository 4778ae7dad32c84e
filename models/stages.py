"""LMS-X and LMS-Y: every number with its unit and source, and the structure they make."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from models.errors import BadParameter, UnknownStage
from models.structure import GROUND, Body, Joint, Structure, assemble

SOURCES = ("paper", "catalogue", "calibrated", "our choice")


@dataclass(frozen=True, slots=True)
class Number:
    """A value (SI) with its unit and where it comes from."""

    value: float
    unit: str
    source: str


@dataclass(frozen=True, slots=True)
class Point:
    """A point or three lengths (m) with where they come from."""

    value: tuple[float, float, float]
    unit: str
    source: str


@dataclass(frozen=True, slots=True)
class Condition:
    """What changes in a life: preload and mount stiffness as fractions, temperature (°C)."""

    guide_preload: float = 1.0
    mount_stiffness: float = 1.0
    temperature_c: float = 21.0

    def __post_init__(self) -> None:
        """Refuse conditions in which the contact law means nothing."""
        for name in ("guide_preload", "mount_stiffness"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.01 <= value <= 100.0):
                raise BadParameter(name, value, "a fraction of commissioning within 0.01..100")
        if not -40.0 <= self.temperature_c <= 120.0:
            raise BadParameter("temperature_c", self.temperature_c, "within -40..120 °C")


NOMINAL = Condition()


@dataclass(frozen=True, slots=True)
class Stage:
    """All numbers of one configuration.

    ``mount_half_spacing``, ``isolator_half_spacing`` and ``block_half_spacing`` give the half
    distances along x and y, and the height of the joints' plane.
    """

    name: str
    identity_suffix: str
    moving_mass: Number
    load_height: Number
    load_offset_feed: Number
    load_offset_lateral: Number
    roll_radius: Number
    pitch_radius: Number
    yaw_radius: Number
    housing_mass: Number
    housing_box: Point
    housing_height: Number
    granite_mass: Number
    granite_box: Point
    granite_height: Number
    granite_yaw_radius: Number
    block_stiffness: Number
    block_lateral_ratio: Number
    block_half_spacing: Point
    mount_stiffness: Number
    mount_half_spacing: Point
    isolator_feed: Number
    isolator_lateral: Number
    isolator_vertical: Number
    isolator_half_spacing: Point
    guide_loss_time: Number
    mount_loss_time: Number
    isolator_horizontal_loss_time: Number
    isolator_vertical_loss_time: Number
    preload_exponent: Number
    temperature_softening: Number
    temperature_reference: Number
    payload: Number
    travel: Number
    encoder_count: Number
    encoder_period: Number
    magnet_pitch: Number
    ball_pitch: Number
    motor_point: Point
    encoder_point: Point
    acc_feed_point: Point
    acc_pitch_point: Point

    def __post_init__(self) -> None:
        """Refuse a number without a known source."""
        for field in fields(self):
            entry = getattr(self, field.name)
            if isinstance(entry, Number | Point) and entry.source not in SOURCES:
                raise BadParameter(f"source of {field.name}", entry.source, ", ".join(SOURCES))


_LMS_X = Stage(
    name="lms-x",
    identity_suffix="X",
    moving_mass=Number(23.5, "kg", "paper"),
    load_height=Number(0.1039624, "m", "calibrated"),
    load_offset_feed=Number(0.012, "m", "our choice"),
    load_offset_lateral=Number(0.0, "m", "our choice"),
    roll_radius=Number(0.3902901, "m", "calibrated"),
    pitch_radius=Number(0.09355964, "m", "calibrated"),
    yaw_radius=Number(0.1606378, "m", "calibrated"),
    housing_mass=Number(12.0, "kg", "our choice"),
    housing_box=Point((0.50, 0.165, 0.06), "m", "our choice"),
    housing_height=Number(-0.030, "m", "our choice"),
    granite_mass=Number(400.0, "kg", "our choice"),
    granite_box=Point((1.00, 0.60, 0.25), "m", "our choice"),
    granite_height=Number(-0.185, "m", "our choice"),
    granite_yaw_radius=Number(0.3303128, "m", "calibrated"),
    block_stiffness=Number(60067770.0, "N/m", "calibrated"),
    block_lateral_ratio=Number(1.0, "1", "our choice"),
    block_half_spacing=Point((0.050, 0.060, 0.0), "m", "our choice"),
    mount_stiffness=Number(2.5e9, "N/m", "our choice"),
    mount_half_spacing=Point((0.20, 0.0675, -0.060), "m", "our choice"),
    isolator_feed=Number(664878.4, "N/m", "calibrated"),
    isolator_lateral=Number(0.9e6, "N/m", "our choice"),
    isolator_vertical=Number(5803482.0, "N/m", "calibrated"),
    isolator_half_spacing=Point((0.36, 0.22, -0.310), "m", "our choice"),
    guide_loss_time=Number(3.6e-5, "s", "our choice"),
    mount_loss_time=Number(8.0e-6, "s", "our choice"),
    isolator_horizontal_loss_time=Number(8.0e-4, "s", "our choice"),
    isolator_vertical_loss_time=Number(3.6e-4, "s", "our choice"),
    preload_exponent=Number(1.0 / 3.0, "1", "our choice"),
    temperature_softening=Number(1.6e-3, "1/K", "our choice"),
    temperature_reference=Number(21.0, "°C", "our choice"),
    payload=Number(20.0, "kg", "our choice"),
    travel=Number(0.300, "m", "catalogue"),
    encoder_count=Number(4.8828125e-9, "m", "paper"),
    encoder_period=Number(20e-6, "m", "our choice"),
    magnet_pitch=Number(0.024, "m", "our choice"),
    ball_pitch=Number(0.004, "m", "our choice"),
    motor_point=Point((0.0, 0.0, -0.020), "m", "our choice"),
    encoder_point=Point((0.0, 0.055, -0.010), "m", "our choice"),
    acc_feed_point=Point((0.070, 0.070, 0.030), "m", "our choice"),
    acc_pitch_point=Point((0.060, 0.060, 0.015), "m", "our choice"),
)

_LMS_Y = replace(
    _LMS_X,
    name="lms-y",
    identity_suffix="Y",
    moving_mass=Number(25.0, "kg", "paper"),
    load_height=Number(0.145276, "m", "calibrated"),
    roll_radius=Number(0.125093, "m", "calibrated"),
    pitch_radius=Number(0.1596021, "m", "calibrated"),
    yaw_radius=Number(0.1483748, "m", "calibrated"),
    granite_yaw_radius=Number(0.3858891, "m", "calibrated"),
    mount_stiffness=Number(94430210.0, "N/m", "calibrated"),
    mount_half_spacing=Point((0.075, 0.0675, -0.060), "m", "our choice"),
    mount_loss_time=Number(3.6e-5, "s", "our choice"),
)

STAGES = {stage.name: stage for stage in (_LMS_X, _LMS_Y)}


def stage_named(name: str) -> Stage:
    """Return a stage by its name.

    Raises
    ------
    UnknownStage
        If the name is neither ``lms-x`` nor ``lms-y``.
    """
    try:
        return STAGES[name]
    except KeyError:
        raise UnknownStage(name, STAGES) from None


def _box_radii(box: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the radii of gyration (m) of a solid box with the given edges (m)."""
    x, y, z = box
    return math.hypot(y, z) / 12**0.5, math.hypot(x, z) / 12**0.5, math.hypot(x, y) / 12**0.5


def _bodies(stage: Stage) -> list[Body]:
    """Return granite, housing and platform with its load."""
    granite = _box_radii(stage.granite_box.value)
    centre = (
        stage.load_offset_feed.value,
        stage.load_offset_lateral.value,
        stage.load_height.value,
    )
    radii = (stage.roll_radius.value, stage.pitch_radius.value, stage.yaw_radius.value)
    return [
        Body(
            "granite",
            stage.granite_mass.value,
            (0.0, 0.0, stage.granite_height.value),
            (granite[0], granite[1], stage.granite_yaw_radius.value),
        ),
        Body(
            "housing",
            stage.housing_mass.value,
            (0.0, 0.0, stage.housing_height.value),
            _box_radii(stage.housing_box.value),
        ),
        Body("platform", stage.moving_mass.value, centre, radii),
    ]


GRANITE, HOUSING, PLATFORM = range(3)


def corners(spacing: Point) -> list[tuple[float, float, float]]:
    """Return the four corners of a joint group, m: (+,+), (+,-), (-,+), (-,-) in x and y."""
    x, y, z = spacing.value
    return [(sx * x, sy * y, z) for sx in (1, -1) for sy in (1, -1)]


def build_structure(stage: Stage, condition: Condition = NOMINAL) -> Structure:
    """Assemble the structure of a stage in a condition.

    Guide contact stiffness grows with preload to the power 1/3 (Hertz); the mount factor scales
    the mount's springs; all joints soften with temperature.
    """
    warm = condition.temperature_c - stage.temperature_reference.value
    soft = math.exp(-stage.temperature_softening.value * warm)
    block = stage.block_stiffness.value * soft
    block *= condition.guide_preload**stage.preload_exponent.value
    mount = stage.mount_stiffness.value * soft * condition.mount_stiffness
    inner, outer = stage.guide_loss_time.value, stage.mount_loss_time.value
    flat, upright = (
        stage.isolator_horizontal_loss_time.value,
        stage.isolator_vertical_loss_time.value,
    )
    isolator = (
        stage.isolator_feed.value * soft,
        stage.isolator_lateral.value * soft,
        stage.isolator_vertical.value * soft,
    )
    guide = (0.0, block * stage.block_lateral_ratio.value, block)
    joints = [
        Joint("isolator", GROUND, GRANITE, p, isolator, (flat, flat, upright))
        for p in corners(stage.isolator_half_spacing)
    ]
    joints += [
        Joint("mount", GRANITE, HOUSING, p, (mount,) * 3, (outer,) * 3)
        for p in corners(stage.mount_half_spacing)
    ]
    joints += [
        Joint("guide", HOUSING, PLATFORM, p, guide, (inner,) * 3)
        for p in corners(stage.block_half_spacing)
    ]
    return assemble(_bodies(stage), joints)
