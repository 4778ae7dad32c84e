"""What a fleet teaches: exact where it can be computed, from the others alone, and well-formed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from lmshealth._arrays import FloatArray
from lmshealth._serialize import pack, unpack
from lmshealth.prognosis import constants
from lmshealth.prognosis import fleet_prior as fleet
from lmshealth.prognosis.fleet_prior import (
    FleetPrior,
    LawEvidence,
    MachineEvidence,
    fleet_priors,
    machine_evidence,
    needs_fleet_prior,
    pace_likelihood,
)
from lmshealth.prognosis.life_likelihood import LifeLikelihood, scatter_prior
from lmshealth.prognosis.life_posterior import LifePosterior, fit_life
from lmshealth.prognosis.scenarios import list_scenarios
from lmshealth.stage.degradation_laws import (
    AnyLaw,
    HertzWear,
    Linear,
    Loosening,
    Power,
    Unchanging,
)
from lmshealth.stage.description import ParameterSpec, ScatterPrior, Stage
from lmshealth.stage.priors import Lognormal, Normal, Uniform
from lmshealth.tracking.history import History
from tests.lives import FOOT, FREQUENCY, MOUNT, PRELOAD, make_history, make_stage, true_drift

NONE = '{ kind = "none" }'
WEAR_OR_NOT = PRELOAD.replace("law = {", "law = [{").replace("} }\n", "} }, " + NONE + "]\n")
STILL_MOUNT = MOUNT[: MOUNT.index("[parameter.law]")]
# Which no mode sees, though it has a limit and a law.
LIMITED_FOOT = FOOT + (
    "limit = { below = 0.8 }\n"
    'law = { kind = "hertz-wear", life_km = { kind = "lognormal", median = 8000, sigma = 1.0 } }\n'
)
N = 4000
FLAT = np.zeros((1, 1))
WALKS, SCALES, DEVIATIONS = (0.2,) * 5, (0.9, 0.07, 0.03), (0.6, 0.3, 0.1)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Preload that wears or not, under a mount that keeps its stiffness."""
    return make_stage(tmp_path_factory.mktemp("stage"), (WEAR_OR_NOT, STILL_MOUNT))


def gaussian(z: float, error: float) -> FloatArray:
    """Make evenly spread draws of a pace that was measured to be z, with some error."""
    width = 1 / np.sqrt(1 + 1 / error**2)
    levels = (np.arange(N) + 0.5) / N
    return np.asarray(stats.norm(z * width**2 / error**2, width).ppf(levels))


def scattering(walk: tuple[float, ...] = WALKS) -> dict[str, tuple[LawEvidence, ...]]:
    """Make what a machine says of scatter: something of the walk alone."""
    after = {"walk": walk, "noise_scale": SCALES, "deviation": DEVIATIONS}
    before = {"walk": WALKS, "noise_scale": SCALES, "deviation": DEVIATIONS}
    return {
        name: tuple(LawEvidence(b, a, FLAT) for b, a in zip(before[name], after[name], strict=True))
        for name in before
    }


def told(z: float, error: float, wears: float = 0.5, *, informed: float = 0.9) -> MachineEvidence:
    """Make the lesson of a machine whose pace was measured, if it wears."""
    pace = pace_likelihood(gaussian(z, error), np.full(N, 1 / N))
    laws = {
        "guide_preload": {
            "hertz-wear": LawEvidence(0.5, wears, pace),
            "none": LawEvidence(0.5, 1 - wears, FLAT),
        },
        "mount_stiffness": {"none": LawEvidence(1.0, 1.0, FLAT)},
    }
    return MachineEvidence(laws, scattering(), informed)


def silent() -> MachineEvidence:
    """Make the lesson of a young machine that says nothing at all."""
    pace = np.zeros_like(told(0.0, 1.0).laws["guide_preload"]["hertz-wear"].pace)
    heard = {"hertz-wear": LawEvidence(0.5, 0.5, pace), "none": LawEvidence(0.5, 0.5, FLAT)}
    still = {"none": LawEvidence(1.0, 1.0, FLAT)}
    return MachineEvidence({"guide_preload": heard, "mount_stiffness": still}, scattering(), 0.0)


def wear_of(learned: FleetPrior) -> tuple[float, Lognormal]:
    """Give the learned share of machines that wear, and the prior of their lives."""
    law = learned.laws[0]
    assert law.kind == "hertz-wear"
    assert law.pace is not None
    assert isinstance(law.pace[1], Lognormal)
    return law.share[1], law.pace[1]


def taught_by(teachers: Mapping[str, MachineEvidence], stage: Stage) -> tuple[float, Lognormal]:
    """Give what teachers teach a machine that says nothing itself."""
    return wear_of(fleet_priors(stage, dict(teachers) | {"young": silent()})["young"])


@pytest.mark.parametrize(("z", "error"), [(0.3, 0.2), (-1.5, 0.4), (1.0, 2.0)])
def test_likelihood_of_a_fleet_is_that_of_the_textbook(z: float, error: float) -> None:
    """With Gaussian measurements data have the density N(z; m, v + e²) over N(z; 0, 1 + e²)."""
    found = pace_likelihood(gaussian(z, error), np.full(N, 1 / N))
    mean, variance = constants.FLEET_MEAN, constants.FLEET_VARIANCE
    expected = stats.norm(mean, np.sqrt(variance + error**2)).logpdf(z)
    expected -= stats.norm(0, np.sqrt(1 + error**2)).logpdf(z)
    # Where the fleet is where the draws are; beyond them it is improbable, and only has to be so.
    near = np.abs(mean - z) < 3 * np.sqrt(variance + error**2)
    far = (mean**2 < 6 * (1 - variance)) & near
    np.testing.assert_allclose(found[far], expected[far], atol=0.02)
    assert far.sum() > 100


@pytest.mark.parametrize("z", [-2.0, 0.0, 1.3])
def test_an_unknown_fleet_has_the_prior_of_the_description(z: float) -> None:
    """Averaged over all fleets a machine is as probable as by the description, whatever its z."""
    shape = constants.FLEET_MEAN.size, constants.FLEET_VARIANCE.size
    log_prior = np.broadcast_to(fleet._LOG_PRIOR, shape)
    weight = np.exp(log_prior) / np.exp(log_prior).sum()
    ratio = np.exp(pace_likelihood(np.array([z]), np.ones(1)))
    assert np.sum(weight * ratio) == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_learned_prior_is_that_of_dense_integration(stage: Stage) -> None:
    """Median, sigma and share are those of the hierarchical model integrated independently."""
    z = np.array([0.9, 1.4, 1.1, 0.4, 1.8, 1.2])
    errors = np.array([0.1, 0.3, 0.2, 0.5, 0.3, 0.1])
    wears = np.array([0.99, 0.9, 0.6, 0.8, 0.9, 0.95])
    pairs = zip(z, errors, wears, strict=True)
    teachers = {str(k): told(*three) for k, three in enumerate(pairs)}
    share, prior = taught_by(teachers, stage)
    m = np.linspace(-4, 4, 321)[:, None, None]
    v = ((np.arange(80) + 0.5) / 80)[None, :, None]
    s = (np.arange(100) + 0.5) / 100
    log_p = stats.norm.logpdf(m, 0, np.sqrt(1 - v)) + np.zeros(s.size)
    for one, error, probability in zip(z, errors, wears, strict=True):
        ratio = stats.norm.pdf(one, m, np.sqrt(v + error**2)) / stats.norm.pdf(
            one, 0, np.sqrt(1 + error**2)
        )
        log_p = log_p + np.log(2 * s * probability * ratio + 2 * (1 - s) * (1 - probability))
    weight = np.exp(log_p - log_p.max())
    expected_share = np.sum(weight * s) / weight.sum()
    weight = weight * s / np.sum(weight * s)
    mean = np.sum(weight * m)
    std = np.sqrt(np.sum(weight * (v + m**2)) - mean**2)
    # Two digits are told.
    assert share == pytest.approx(expected_share, rel=0.02)
    assert np.log(prior.median / 8000) == pytest.approx(mean, abs=0.06)
    assert prior.sigma == pytest.approx(std, rel=0.03)


def test_few_teachers_leave_the_description(stage: Stage) -> None:
    """Two other machines teach nothing; three do."""
    teachers = {str(k): told(1.0, 0.1) for k in range(3)}
    assert fleet_priors(stage, {"young": silent()}) == {}
    two = {name: teachers[name] for name in ("0", "1")}
    assert fleet_priors(stage, two | {"young": silent()}) == {}
    assert set(fleet_priors(stage, teachers | {"young": silent()})) == {"young"}


@pytest.mark.slow
def test_machines_that_say_nothing_teach_the_description(stage: Stage) -> None:
    """However many there are, the learned prior is the description's."""
    learned = fleet_priors(stage, {str(k): silent() for k in range(30)})
    assert len(learned) == 30
    share, prior = wear_of(learned["7"])
    assert share == 0.5
    assert prior == Lognormal(8000, 1.0)
    assert learned["7"].scatter == ScatterPrior(WALKS, SCALES, DEVIATIONS)


@pytest.mark.slow
def test_scatter_of_a_fleet_is_learned(stage: Stage) -> None:
    """Where all logs ask for one walk it is expected of a young machine, and no other of it."""
    walks = (0.01, 0.02, 0.9, 0.05, 0.02)
    teachers = {str(k): replace(silent(), scatter=scattering(walks)) for k in range(20)}
    learned = fleet_priors(stage, teachers | {"young": silent()})["young"]
    taught = learned.apply_to(stage)
    assert taught.scatter == learned.scatter
    assert learned.scatter.walk[2] > 0.7
    assert max(learned.scatter.walk[k] for k in (0, 1, 3, 4)) < 0.15
    assert learned.scatter.noise_scale == SCALES
    history = lived(np.linspace(0.0, 2e6, 8), 4000.0)
    before, after = (LifeLikelihood.of(history, one).grid for one in (stage, taught))
    k = np.searchsorted(np.unique(before.walk), before.walk)
    expected = np.log(np.array(learned.scatter.walk) / scatter_prior(stage).walk)[k]
    np.testing.assert_allclose(after.log_weight - before.log_weight, expected, atol=1e-9)


@pytest.mark.slow
def test_nobody_teaches_itself(stage: Stage) -> None:
    """What a young machine says changes what others learn, and nothing of its own prior."""
    teachers = {str(k): told(0.2 * k, 0.2, 0.9) for k in range(6)}
    slow = teachers | {"a": told(2.0, 0.5, 0.9, informed=0.1), "b": silent()}
    fast = teachers | {"a": told(-2.0, 0.5, 0.1, informed=0.1), "b": silent()}
    of_slow, of_fast = fleet_priors(stage, slow), fleet_priors(stage, fast)
    assert of_slow["a"] == of_fast["a"]
    assert of_slow["a"].n_machines == 7
    assert wear_of(of_slow["b"])[1].median > wear_of(of_fast["b"])[1].median
    assert wear_of(of_slow["b"])[0] > wear_of(of_fast["b"])[0]


def test_order_of_machines_does_not_matter(stage: Stage) -> None:
    """The same lessons in any order teach the same, to the last bit."""
    lessons = {str(k): told(0.3 * k - 1, 0.3, 0.1 + 0.08 * k) for k in range(8)}
    lessons |= {"young": silent(), "other": silent()}
    backward = dict(reversed(lessons.items()))
    assert fleet_priors(stage, lessons) == fleet_priors(stage, backward)


def test_machines_without_wear_make_lives_longer(stage: Stage) -> None:
    """Those that are sound teach that fewer machines wear, and that lives are longer."""
    worn = {f"worn-{k}": told(-1.0 + 0.2 * k, 0.1, 0.99) for k in range(6)}
    share, prior = taught_by(worn, stage)
    # Sound after a long way: if they wear at all, then slowly.
    slow = gaussian(0.0, 10.0)
    slow = slow[slow > 0.5]
    pace = pace_likelihood(slow, np.full(slow.size, 1 / slow.size))
    sound = told(0.0, 1.0)
    heard = {"hertz-wear": LawEvidence(0.5, 0.3, pace), "none": LawEvidence(0.5, 0.7, FLAT)}
    sound = replace(sound, laws=sound.laws | {"guide_preload": heard})
    more, longer = taught_by(worn | {f"sound-{k}": sound for k in range(6)}, stage)
    assert more < share - 0.1
    assert longer.median > 1.2 * prior.median


def test_lessons_and_what_was_learned_survive_packing(stage: Stage) -> None:
    """Both come back as they were, and a lesson is small."""
    lesson = told(0.5, 0.3)
    content = pack(lesson)
    back = unpack(content, MachineEvidence)
    assert pack(back) == content
    heard = back.laws["guide_preload"]["hertz-wear"]
    np.testing.assert_array_equal(heard.pace, lesson.laws["guide_preload"]["hertz-wear"].pace)
    assert len(content) < 30_000
    learned = fleet_priors(stage, {str(k): told(1.0, 0.2) for k in range(4)} | {"young": silent()})
    assert unpack(pack(learned["young"]), FleetPrior) == learned["young"]


KINDS: list[tuple[AnyLaw, str]] = [
    (HertzWear(life_km=Lognormal(8000, 1.0)), "life_km"),
    (Power(life_km=Lognormal(8000, 1.0)), "life_km"),
    (Loosening(life_km=Lognormal(4000, 1.0), floor=Uniform(0.3, 1.0)), "life_km"),
    (Linear(rate_per_km=Lognormal(1e-4, 0.8)), "rate_per_km"),
    (Linear(rate_per_km=Normal(0.0, 1e-4)), "rate_per_km"),
    (HertzWear(life_km=Uniform(1000, 9000)), ""),
    (HertzWear(life_km=Normal(8000, 3000)), ""),
    (Unchanging(), ""),
]


@pytest.mark.parametrize(("law", "field"), KINDS)
def test_learned_laws_are_laws_of_a_description(stage: Stage, law: AnyLaw, field: str) -> None:
    """Of every kind: only the prior of its pace changes, and a description could say the same."""
    other = Unchanging() if law.names else HertzWear(life_km=Lognormal(8000, 1.0))
    spec = ParameterSpec(name="guide_preload", prior=Lognormal(1.0, 0.3), law=(law, other))
    own = replace(stage, description=msgspec.structs.replace(stage.description, parameter=(spec,)))
    pace = told(0.8, 0.2).laws["guide_preload"]["hertz-wear"].pace

    def heard(one: AnyLaw, after: float) -> LawEvidence:
        return LawEvidence(0.5, after, pace if fleet._pace_field(one) else FLAT)

    laws = {"guide_preload": {law.kind: heard(law, 0.8), other.kind: heard(other, 0.2)}}
    learned = fleet_priors(
        own, {str(k): MachineEvidence(laws, scattering(), 0.1) for k in range(5)}
    )["3"]
    taught = learned.apply_to(own)
    found = taught.parameters[0].laws[0]
    assert learned.laws[0].field == field
    assert found.weight > 0.6
    changed = {name for name in law.__struct_fields__ if getattr(found, name) != getattr(law, name)}
    assert changed == {"weight", *([field] if field else [])}
    written = msgspec.json.encode(taught.parameters[0])
    assert msgspec.json.decode(written, type=ParameterSpec).laws[0] == found
    weights = [scenario.weight for scenario in list_scenarios(taught.parameters, (), 1e6)]
    assert sum(weights) == pytest.approx(1.0)
    if field:
        before, after = getattr(law, field), getattr(found, field)
        assert after.quantile(0.5) > before.quantile(0.5)
        assert np.diff(after.quantile([0.1, 0.9])) < np.diff(before.quantile([0.1, 0.9])) * 2.5


def test_a_taught_stage_has_its_own_digest(stage: Stage) -> None:
    """Other teaching is another digest, the same teaching the same one."""
    lessons = {str(k): told(1.0, 0.2) for k in range(4)} | {"young": silent()}
    learned = fleet_priors(stage, lessons)["young"]
    taught = learned.apply_to(stage)
    assert taught.digest != stage.digest
    assert learned.apply_to(stage).digest == taught.digest
    other = fleet_priors(stage, lessons | {"0": told(-2.0, 0.1)})["young"].apply_to(stage)
    assert other.digest not in (stage.digest, taught.digest)
    assert taught.modal_map is stage.modal_map


def test_what_is_learned_is_told_in_two_digits(stage: Stage) -> None:
    """A teacher that says a little more changes no prior, so that no young machine is stale."""
    lessons = {str(k): told(1.0, 0.2) for k in range(9)} | {"young": silent()}
    moved = lessons | {"0": told(1.0005, 0.2)}
    assert fleet_priors(stage, moved)["young"] == fleet_priors(stage, lessons)["young"]


@pytest.fixture(scope="module")
def small_grid() -> Iterator[None]:
    """Average over one walk and no deviation: lessons of a posterior are made alike by any."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "WALKS", (1e-5,))
        patch.setattr(constants, "NOISE_SCALES", (1.0,))
        patch.setattr(constants, "NOISE_SCALE_PRIOR", (1.0,))
        patch.setattr(constants, "DEVIATIONS", (0.0,))
        patch.setattr(constants, "DEVIATION_PRIOR", (1.0,))
        yield


def lived(travel: FloatArray, life_km: float) -> History:
    """Make the life of a preload that wears, with errors of 5e-4 in ln f."""
    health = np.column_stack([(1 - travel / 1000 / life_km) ** 1.5, np.ones(travel.size)])
    drift = true_drift(("guide_preload", "mount_stiffness"), np.log(health))[:, :2]
    noise = 5e-4 * np.random.default_rng(2).standard_normal(drift.shape)
    return make_history(np.log(FREQUENCY[:2]) + drift + noise, travel=travel, std=5e-4)


def fitted(history: History, stage: Stage) -> LifePosterior:
    """Fit a life quickly."""
    return fit_life(history, stage, 5, chains=False, n_draws=2000)


def test_a_machine_is_young_until_its_logs_tell_its_life(small_grid: None, stage: Stage) -> None:
    """A life of 4,000 km is told after 2,000 of them, and not after 40."""
    old = machine_evidence(stage, fitted(lived(np.linspace(0.0, 2e6, 12), 4000.0), stage))
    new = machine_evidence(stage, fitted(lived(np.linspace(0.0, 4e4, 6), 4000.0), stage))
    assert not needs_fleet_prior(old)
    assert old.informed > 0.95
    assert needs_fleet_prior(new)
    assert new.informed < 0.3
    assert len(pack(old)) < 30_000


def test_a_lesson_says_what_the_posterior_says(small_grid: None, stage: Stage) -> None:
    """Probabilities of laws are those of the posterior, and the likeliest fleet has its life."""
    posterior = fitted(lived(np.linspace(0.0, 2e6, 12), 4000.0), stage)
    heard = machine_evidence(stage, posterior).laws
    laws = posterior.laws("guide_preload")
    for kind, one in heard["guide_preload"].items():
        assert one.prior == 0.5
        assert one.posterior == pytest.approx(laws.get((kind, 0.0), 0.0))
    assert heard["mount_stiffness"]["none"].posterior == pytest.approx(1.0)
    pace = heard["guide_preload"]["hertz-wear"].pace
    best = float(constants.FLEET_MEAN[np.argmax(pace[:, 0]), 0])
    assert 8000 * np.exp(best) == pytest.approx(4000, rel=0.25)


def test_a_law_that_is_ruled_out_teaches_its_share_alone(small_grid: None, stage: Stage) -> None:
    """A part that keeps its health says that few wear, and nothing of how fast others do."""
    still = machine_evidence(stage, fitted(lived(np.linspace(0.0, 4e6, 12), 1e9), stage))
    heard = still.laws["guide_preload"]["hertz-wear"]
    assert heard.posterior < 0.05
    ruled_out = replace(heard, posterior=0.0, pace=np.zeros_like(heard.pace))
    laws = {"hertz-wear": ruled_out, "none": LawEvidence(0.5, 1.0, FLAT)}
    sound = replace(still, laws=still.laws | {"guide_preload": laws}, informed=0.0)
    share, prior = wear_of(fleet_priors(stage, {str(k): sound for k in range(5)})["0"])
    assert share < 0.2
    assert prior == Lognormal(8000, 1.0)


def test_what_no_mode_tells_makes_nobody_young(small_grid: None, tmp_path: Path) -> None:
    """A part that the modes cannot see stays unknown for ever: that is no question of age."""
    blind = make_stage(tmp_path, (PRELOAD, STILL_MOUNT, LIMITED_FOOT))
    posterior = fitted(lived(np.linspace(0.0, 2e6, 12), 4000.0), blind)
    lesson = machine_evidence(blind, posterior)
    assert not needs_fleet_prior(lesson)
    # Nor does such a machine teach anything of it.
    assert np.abs(lesson.laws["foot"]["hertz-wear"].pace[15:26, 4:]).max() < 0.5
