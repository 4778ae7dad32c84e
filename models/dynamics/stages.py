"""LMS-X and LMS-Y: every number with its unit and source, and the structure they make."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from models.dynamics.elastic import (
    Attachment,
    ElasticMode,
    FreeBeam,
    Overhang,
    Part,
    attached_mode,
    beam_mode,
    overhang_mode,
)
from models.dynamics.quantities import Number, Point, refuse_unstated
from models.dynamics.servo import MEASURED, TUNINGS, Tuning
from models.dynamics.structure import GROUND, Body, Joint, Structure, assemble
from models.errors import BadParameter, UnknownServo, UnknownStage


@dataclass(frozen=True, slots=True)
class Condition:
    """What changes in a life.

    Parameters
    ----------
    guide_preload, mount_stiffness
        Fractions of commissioning.
    temperature_c
        Temperature of the joints, °C.
    added_payload
        What the platform carries above the stage's nominal payload, kg; negative below it.
    guide_damping
        Loss of the guide's joints as a fraction of commissioning: the state of the grease.
    servo_id
        Which tuning of the position loop, see `tuning_named`.
    position_mm
        Where the platform stands on its travel, from the middle; rigid stages are alike everywhere.
    """

    guide_preload: float = 1.0
    mount_stiffness: float = 1.0
    temperature_c: float = 21.0
    added_payload: float = 0.0
    guide_damping: float = 1.0
    servo_id: str = "commissioning"
    position_mm: float = 0.0

    def __post_init__(self) -> None:
        """Reject conditions in which the laws of contact and mass mean nothing."""
        for name in ("guide_preload", "mount_stiffness", "guide_damping"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.01 <= value <= 100.0):
                raise BadParameter(name, value, "a fraction of commissioning within 0.01..100")
        if not -40.0 <= self.temperature_c <= 120.0:
            raise BadParameter("temperature_c", self.temperature_c, "within -40..120 °C")
        if not math.isfinite(self.added_payload):
            raise BadParameter("added_payload", self.added_payload, "a finite mass, kg")
        if not abs(self.position_mm) <= 150.0:
            raise BadParameter("position_mm", self.position_mm, "within ±150 mm of the middle")


NOMINAL = Condition()
GRANITE, HOUSING, PLATFORM = range(3)


@dataclass(frozen=True, slots=True)
class Flexible:
    """What a stage is beyond rigid bodies that are the same everywhere on their travel.

    Parameters
    ----------
    parts
        Elastic parts of the bodies.
    block_load_slope
        Relative change of the load of the front blocks per m of travel, 1/m; opposite at the rear:
        the moment of the cable chain and of the housing's overhang.
    bench_offset
        How far the stage stands beside the middle of the granite, lateral, m.
    """

    parts: tuple[Part, ...]
    block_load_slope: Number
    bench_offset: Number

    def __post_init__(self) -> None:
        """Reject a number without a source, and a mass or stiffness that is not positive."""
        for owner in (self, *self.parts):
            refuse_unstated(owner)


@dataclass(frozen=True, slots=True)
class Stage:
    """All numbers of one configuration.

    ``mount_half_spacing``, ``isolator_half_spacing`` and ``block_half_spacing`` give the half
    distances along x and y, and the height of the joints' plane.  A mass added to the nominal
    payload is a block of ``payload_box`` centred at ``payload_height``, straight above the centre
    of gravity of the moving mass.
    """

    name: str
    identity_suffix: str
    moving_mass: Number
    load_height: Number
    load_offset_feed: Number
    load_offset_lateral: Number
    load_spread_feed: Number
    load_spread_lateral: Number
    load_spread_vertical: Number
    housing_mass: Number
    housing_box: Point
    housing_height: Number
    granite_mass: Number
    granite_spread_feed: Number
    granite_spread_lateral: Number
    granite_spread_vertical: Number
    granite_height: Number
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
    friction: Number
    friction_compensation: Number
    feedforward_lead: Number
    payload: Number
    payload_height: Number
    payload_box: Point
    travel: Number
    encoder_count: Number
    encoder_period: Number
    magnet_pitch: Number
    ball_pitch: Number
    motor_point: Point
    encoder_point: Point
    acc_feed_point: Point
    acc_pitch_point: Point
    acc_range: Number
    flexible: Flexible | None = None

    def __post_init__(self) -> None:
        """Reject a number without a source, and a mass or stiffness that is not positive."""
        refuse_unstated(self)


_LMS_X = Stage(
    name="lms-x",
    identity_suffix="X",
    moving_mass=Number(23.5, "kg", "paper"),
    load_height=Number(0.1199835, "m", "calibrated"),
    load_offset_feed=Number(0.012, "m", "our choice"),
    load_offset_lateral=Number(0.001, "m", "our choice"),
    load_spread_feed=Number(0.02988293, "m", "calibrated"),
    load_spread_lateral=Number(0.2004054, "m", "calibrated"),
    load_spread_vertical=Number(0.1146149, "m", "calibrated"),
    housing_mass=Number(16.95535, "kg", "calibrated"),
    housing_box=Point((0.50, 0.165, 0.06), "m", "our choice"),
    housing_height=Number(-0.030, "m", "our choice"),
    granite_mass=Number(1300.0, "kg", "our choice"),
    granite_spread_feed=Number(0.423226, "m", "calibrated"),
    granite_spread_lateral=Number(0.289, "m", "our choice"),
    granite_spread_vertical=Number(0.087, "m", "our choice"),
    granite_height=Number(-0.210, "m", "our choice"),
    block_stiffness=Number(4.9227e07, "N/m", "calibrated"),
    block_lateral_ratio=Number(1.0, "1", "our choice"),
    block_half_spacing=Point((0.070, 0.050, 0.0), "m", "our choice"),
    mount_stiffness=Number(2.5e9, "N/m", "our choice"),
    mount_half_spacing=Point((0.20, 0.0675, -0.060), "m", "our choice"),
    isolator_feed=Number(2069495, "N/m", "calibrated"),
    isolator_lateral=Number(2.9e6, "N/m", "our choice"),
    isolator_vertical=Number(1.783508e07, "N/m", "calibrated"),
    isolator_half_spacing=Point((0.55, 0.36, -0.360), "m", "our choice"),
    guide_loss_time=Number(3.6e-5, "s", "our choice"),
    mount_loss_time=Number(8.0e-6, "s", "our choice"),
    isolator_horizontal_loss_time=Number(1.6e-3, "s", "our choice"),
    isolator_vertical_loss_time=Number(3.6e-4, "s", "our choice"),
    preload_exponent=Number(1.0 / 3.0, "1", "our choice"),
    temperature_softening=Number(1.6e-3, "1/K", "our choice"),
    temperature_reference=Number(21.0, "°C", "our choice"),
    friction=Number(6.0, "N", "our choice"),
    friction_compensation=Number(0.99, "1", "our choice"),
    feedforward_lead=Number(2.0e-4, "s", "our choice"),  # by eye on Table 3
    payload=Number(20.0, "kg", "our choice"),
    payload_height=Number(0.14, "m", "our choice"),
    payload_box=Point((0.20, 0.20, 0.04), "m", "our choice"),
    travel=Number(0.300, "m", "catalogue"),
    encoder_count=Number(4.8828125e-9, "m", "paper"),
    encoder_period=Number(20e-6, "m", "our choice"),
    magnet_pitch=Number(0.024, "m", "our choice"),
    ball_pitch=Number(0.004, "m", "our choice"),
    motor_point=Point((0.0, 0.0, -0.020), "m", "our choice"),
    encoder_point=Point((0.0, 0.055, -0.010), "m", "our choice"),
    acc_feed_point=Point((0.070, 0.070, 0.030), "m", "our choice"),
    acc_pitch_point=Point((0.075, 0.070, 0.015), "m", "our choice"),
    acc_range=Number(500.0, "m/s²", "our choice"),
)

_LMS_Y = replace(
    _LMS_X,
    name="lms-y",
    identity_suffix="Y",
    moving_mass=Number(25.0, "kg", "paper"),
    load_height=Number(0.08773826, "m", "calibrated"),
    load_spread_feed=Number(0.1852465, "m", "calibrated"),
    load_spread_lateral=Number(0.02537977, "m", "calibrated"),
    load_spread_vertical=Number(0.09481414, "m", "calibrated"),
    granite_spread_feed=Number(0.5225683, "m", "calibrated"),
    mount_stiffness=Number(1.210303e08, "N/m", "calibrated"),
    mount_half_spacing=Point((0.100, 0.050, -0.060), "m", "our choice"),
    mount_loss_time=Number(3.6e-5, "s", "our choice"),
)

STAGES = {stage.name: stage for stage in (_LMS_X, _LMS_Y)}


def _attached(
    name: str, point: tuple[float, float, float], mass: float, stiffness: float, damping: float
) -> Attachment:
    """Return a mass on the platform that moves along the feed on a calibrated spring."""
    at, kilograms = Point(point, "m", "our choice"), Number(mass, "kg", "our choice")
    spring = Number(stiffness, "N/m", "calibrated")
    loss, slope = Number(damping, "1", "our choice"), Number(0.0, "1/m", "our choice")
    return Attachment(name, PLATFORM, 0, at, kilograms, spring, slope, loss)


def _bending(name: str, body: int, length: float, stiffness: float) -> FreeBeam:
    """Return the first vertical bending of a body, from its dimensions alone."""
    sizes = Number(length, "m", "our choice"), Number(stiffness, "N m²", "our choice")
    return FreeBeam(name, body, *sizes, Number(0.005, "1", "our choice"))


def _load(name: str, bends: int, parity: int, mass: float, stiffness: float) -> Overhang:
    """Return the load as a bar that overhangs on both sides, across its length alike or not.

    In X it lies across the feed, in Y along it, by the calibrated spreads of the load.
    """
    root, reach = Point((0.0, 0.0, 0.14), "m", "our choice"), Number(0.3, "m", "our choice")
    kilograms, spring = Number(mass, "kg", "our choice"), Number(stiffness, "N m²", "calibrated")
    loss = Number(0.012, "1", "our choice")
    along = 1 if bends == 0 else 0
    return Overhang(name, PLATFORM, along, bends, parity, root, reach, kilograms, spring, loss)


# Housing: aluminium, 0.60 m long, base plate 20 mm and two walls 12 x 60 mm, 70 GPa.  Granite: a
# block 0.30 m high and 1.0 m wide, 55 GPa, of the length that its spread along the feed gives.
# Masses of the attached parts: our choice; resonances of Table 2 that X and Y have alike (255 and
# 271 Hz, 317 and 341 Hz, 742 and 794 Hz, 923 and 927 Hz) are those of parts that they share.
_HOUSING = _bending("housing_bending", HOUSING, 0.60, 1.5e5)


def _cable(mass: float, stiffness: float) -> Attachment:
    """Return the loop of cables of the platform: the further it is pulled, the softer."""
    slope = Number(2.0, "1/m", "our choice")
    return replace(
        _attached("cable_feed", (0.0, 0.09, 0.03), mass, stiffness, 0.03), loosening=slope
    )


def _encoder_head(mass: float, stiffness: float) -> Attachment:
    """Return the head of the encoder on its bracket."""
    head = _attached("encoder_feed", (0.0, 0.055, -0.010), mass, stiffness, 0.015)
    return replace(head, encoder=True)


_FULL_X = replace(
    _LMS_X,
    name="lms-x-full",
    load_offset_feed=Number(0.025, "m", "our choice"),
    load_offset_lateral=Number(0.020, "m", "our choice"),
    guide_loss_time=Number(2.4e-5, "s", "our choice"),
    isolator_horizontal_loss_time=Number(2.0e-3, "s", "our choice"),
    housing_box=Point((0.60, 0.165, 0.06), "m", "our choice"),
    block_stiffness=Number(4.434358e07, "N/m", "calibrated"),
    isolator_feed=Number(2058052, "N/m", "calibrated"),
    isolator_vertical=Number(1.788488e07, "N/m", "calibrated"),
    housing_mass=Number(16.75808, "kg", "calibrated"),
    load_height=Number(0.1169406, "m", "calibrated"),
    load_spread_feed=Number(0.03025437, "m", "calibrated"),
    load_spread_lateral=Number(0.1895174, "m", "calibrated"),
    load_spread_vertical=Number(0.1037917, "m", "calibrated"),
    granite_spread_feed=Number(0.4227731, "m", "calibrated"),
    flexible=Flexible(
        parts=(
            _HOUSING,
            _bending("granite_bending", GRANITE, 1.466, 1.24e8),
            _cable(0.6, 260947.8),
            _attached("cover_feed", (-0.08, 0.0, 0.04), 0.2, 525791.6, 0.015),
            _attached("bracket_feed", (0.0, 0.10, 0.02), 0.4, 1476161, 0.012),
            _load("load_feed", 0, 1, 8.0, 108338.2),
            _attached("adapter_feed", (0.0, 0.0, -0.020), 1.0, 1.822732e07, 0.015),
            _encoder_head(0.1, 3305313),
        ),
        block_load_slope=Number(1.0, "1/m", "our choice"),
        bench_offset=Number(0.0, "m", "our choice"),
    ),
)
_FULL_Y = replace(
    _LMS_Y,
    name="lms-y-full",
    load_offset_feed=Number(0.030, "m", "our choice"),
    load_offset_lateral=Number(0.020, "m", "our choice"),
    guide_loss_time=Number(2.4e-5, "s", "our choice"),
    mount_loss_time=Number(1.2e-5, "s", "our choice"),
    isolator_horizontal_loss_time=Number(0.5e-3, "s", "our choice"),
    housing_box=Point((0.60, 0.165, 0.06), "m", "our choice"),
    feedforward_lead=Number(5.0e-5, "s", "our choice"),  # by eye on Table 3
    mount_half_spacing=Point((0.104, 0.050, -0.060), "m", "our choice"),
    block_stiffness=Number(4.434358e07, "N/m", "calibrated"),
    isolator_feed=Number(2058052, "N/m", "calibrated"),
    isolator_vertical=Number(1.788488e07, "N/m", "calibrated"),
    housing_mass=Number(16.75808, "kg", "calibrated"),
    mount_stiffness=Number(1.501022e08, "N/m", "calibrated"),
    load_height=Number(0.1054973, "m", "calibrated"),
    load_spread_feed=Number(0.1830049, "m", "calibrated"),
    load_spread_lateral=Number(0.02971101, "m", "calibrated"),
    load_spread_vertical=Number(0.05940542, "m", "calibrated"),
    granite_spread_feed=Number(0.5217993, "m", "calibrated"),
    flexible=Flexible(
        parts=(
            _HOUSING,
            _bending("granite_bending", GRANITE, 1.810, 1.24e8),
            _cable(0.6, 86056.53),
            _load("load_pitch", 2, -1, 3.0, 4865.366),
            _attached("cover_feed", (-0.08, 0.0, 0.04), 0.2, 574310.3, 0.015),
            _attached("bracket_feed", (0.0, 0.10, 0.02), 0.4, 1790889, 0.012),
            _attached("adapter_feed", (0.0, 0.0, -0.020), 1.0, 2.33185e07, 0.015),
            _encoder_head(0.1, 3368238),
        ),
        block_load_slope=Number(1.0, "1/m", "our choice"),
        bench_offset=Number(0.32, "m", "our choice"),
    ),
)
FULL_STAGES = {stage.name: stage for stage in (_FULL_X, _FULL_Y)}


def stage_named(name: str) -> Stage:
    """Return a stage by its name, rigid or full.

    Raises
    ------
    UnknownStage
        If there is no stage of that name.
    """
    stages = STAGES | FULL_STAGES
    try:
        return stages[name]
    except KeyError:
        raise UnknownStage(name, stages) from None


# A later retuning to a wider bandwidth, as a user would do it: more gain, with the notch lower in
# X, notch and bi-quad higher in Y (which reaches X's bandwidth), to keep the phase.  Rigid and
# flexible loop keep their margins (tested).
_RETUNED = {
    "lms-x": replace(
        TUNINGS["lms-x"],
        name="retuned",
        drive_gain=1.5 * TUNINGS["lms-x"].drive_gain,
        sections=(replace(TUNINGS["lms-x"].sections[0], frequency_hz=260.0),),
    ),
    "lms-y": replace(
        TUNINGS["lms-y"],
        name="retuned",
        drive_gain=4.0 * TUNINGS["lms-y"].drive_gain,
        sections=(
            replace(TUNINGS["lms-y"].sections[0], frequency_hz=300.0),
            replace(TUNINGS["lms-y"].sections[1], frequency_hz=400.0),
        ),
    ),
}
_RETUNED |= {
    name: replace(tuning, name="retuned", drive_gain=1.3 * tuning.drive_gain)
    for name, tuning in MEASURED.items()
}
SERVOS = {"commissioning": TUNINGS | MEASURED, "retuned": _RETUNED}


def tuning_named(stage: str, servo_id: str) -> Tuning:
    """Return a tuning of a stage's position loop by its servo_id.

    Raises
    ------
    UnknownServo
        If no such tuning is registered in `SERVOS`.
    """
    if servo_id not in SERVOS:
        raise UnknownServo(servo_id, SERVOS)
    return SERVOS[servo_id][stage]


def _box_radii(box: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the radii of gyration (m) of a solid box from its edges (m)."""
    x, y, z = box
    return math.hypot(y, z) / 12**0.5, math.hypot(x, z) / 12**0.5, math.hypot(x, y) / 12**0.5


def _radii(stage: Stage, body: str) -> tuple[float, float, float]:
    """Return the radii of gyration (m) of a body from the spreads of its mass.

    A spread is the root mean square distance of the mass from the centre of gravity along an axis:
    any three make a possible body, which any three radii of gyration do not.
    """
    x, y, z = (
        getattr(stage, f"{body}_spread_{axis}").value for axis in ("feed", "lateral", "vertical")
    )
    return math.hypot(y, z), math.hypot(x, z), math.hypot(x, y)


def _with_block(body: Body, mass: float, height: float, radii: tuple[float, float, float]) -> Body:
    """Return a body and a block (mass in kg, negative if taken away; radii in m) as one.

    The block sits straight above the body's centre, so that no product of inertia arises.
    """
    total = body.mass + mass
    shift = height - body.centre[2]
    # Parallel axes: own inertia of both and that of their distance along z.
    apart = (body.mass * mass / total * shift**2) if total > 0 else math.nan
    inertia = [
        body.mass * own**2 + mass * block**2 + away
        for own, block, away in zip(body.radii, radii, (apart, apart, 0.0), strict=True)
    ]
    if not (min(inertia) > 0 and 2 * max(inertia) <= sum(inertia)):
        raise BadParameter(
            "added_payload", f"{mass} kg", f"to leave {body.name} a possible inertia"
        )
    x, y, z = (math.sqrt(value / total) for value in inertia)
    centre = (body.centre[0], body.centre[1], body.centre[2] + mass / total * shift)
    return replace(body, mass=total, centre=centre, radii=(x, y, z))


def _bodies(stage: Stage, condition: Condition) -> list[Body]:
    """Return granite, housing and platform with its load.

    The origin is in the middle of the blocks: as the platform moves forward, all else moves back.
    """
    centre = (
        stage.load_offset_feed.value,
        stage.load_offset_lateral.value,
        stage.load_height.value,
    )
    platform = Body("platform", stage.moving_mass.value, centre, _radii(stage, "load"))
    if condition.added_payload:
        platform = _with_block(
            platform,
            condition.added_payload,
            stage.payload_height.value,
            _box_radii(stage.payload_box.value),
        )
    back, aside = _granite_middle(stage, condition)
    granite = (back, aside, stage.granite_height.value)
    housing = (back, 0.0, stage.housing_height.value)
    box = _box_radii(stage.housing_box.value)
    bodies = [
        Body("granite", stage.granite_mass.value, granite, _radii(stage, "granite")),
        Body("housing", stage.housing_mass.value, housing, box),
        platform,
    ]
    if stage.flexible:
        bodies = [
            replace(body, elastic=_elastic(stage, stage.flexible.parts, condition, i, body))
            for i, body in enumerate(bodies)
        ]
    return bodies


def _granite_middle(stage: Stage, condition: Condition) -> tuple[float, float]:
    """Return feed and lateral coordinate of the granite's middle, m: rigid stages stand on it."""
    if stage.flexible is None:
        return 0.0, 0.0
    return 0.0 - 1e-3 * condition.position_mm, 0.0 - stage.flexible.bench_offset.value


def _elastic(
    stage: Stage, parts: tuple[Part, ...], condition: Condition, index: int, body: Body
) -> tuple[ElasticMode, ...]:
    """Return the elastic modes of a body; joints soften with temperature, bodies hardly."""
    modes: list[ElasticMode] = []
    for part in parts:
        if part.body != index:
            continue
        if isinstance(part, FreeBeam):
            modes.append(beam_mode(part, body.mass))
        elif isinstance(part, Overhang):
            carried = 1 + condition.added_payload / stage.payload.value
            modes.append(overhang_mode(part, np.array(body.centre), carried))
        else:
            travel = 1e-3 * condition.position_mm
            modes.append(attached_mode(part, np.array(body.centre), travel))
    return tuple(modes)


def corners(spacing: Point) -> list[tuple[float, float, float]]:
    """Return the four corners of a joint group, m: (+,+), (+,-), (-,+), (-,-) in x and y."""
    x, y, z = spacing.value
    return [(sx * x, sy * y, z) for sx in (1, -1) for sy in (1, -1)]


# Each evaluation of a plant needs its structure four times; cached values are read-only.
@lru_cache(maxsize=64)
def build_structure(stage: Stage, condition: Condition = NOMINAL) -> Structure:
    """Assemble the structure of a stage in a condition.

    Guide contact stiffness grows with preload to the power 1/3 (Hertz); the mount factor scales
    the mount's springs; all joints soften with temperature.  The grease changes the guide's loss,
    the payload the platform's mass, height and inertia.

    Raises
    ------
    BadParameter
        If more payload is taken away than there is.
    """
    carried = stage.payload.value + condition.added_payload
    if carried < 0:
        needed = f"0 kg or more: {stage.payload.value} kg can be taken off"
        raise BadParameter("payload", f"{carried} kg", needed)
    warm = condition.temperature_c - stage.temperature_reference.value
    soft = math.exp(-stage.temperature_softening.value * warm)
    block = stage.block_stiffness.value * soft
    block *= condition.guide_preload**stage.preload_exponent.value
    mount = stage.mount_stiffness.value * soft * condition.mount_stiffness
    inner = stage.guide_loss_time.value * condition.guide_damping
    outer = stage.mount_loss_time.value
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
    back, aside = _granite_middle(stage, condition)
    joints = [
        Joint(
            "isolator", GROUND, GRANITE, (x + back, y + aside, z), isolator, (flat, flat, upright)
        )
        for x, y, z in corners(stage.isolator_half_spacing)
    ]
    joints += [
        Joint("mount", GRANITE, HOUSING, (x + back, y, z), (mount,) * 3, (outer,) * 3)
        for x, y, z in corners(stage.mount_half_spacing)
    ]
    for p in corners(stage.block_half_spacing):
        springs = guide
        if stage.flexible:
            load = 1 - math.copysign(stage.flexible.block_load_slope.value, p[0]) * back
            share = load**stage.preload_exponent.value
            springs = (0.0, guide[1] * share, guide[2] * share)
        joints.append(Joint("guide", HOUSING, PLATFORM, p, springs, (inner,) * 3))
    return assemble(_bodies(stage, condition), joints)
