"""Fleet prior: closed forms and quadrature, evidence of the others alone, formats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from lmshealth._private.arrays import FloatArray
from lmshealth._private.serialize import pack, unpack
from lmshealth.life import constants
from lmshealth.life import fleet_prior as fleet
from lmshealth.life.fleet_prior import (
    EndedLife,
    FleetPrior,
    LawEvidence,
    MachineEvidence,
    calibrate,
    ended_lives,
    fleet_priors,
    machine_evidence,
    needs_fleet_prior,
    pace_likelihood,
)
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.posterior.likelihood import LifeLikelihood, common_kernel, scatter_prior
from lmshealth.life.posterior.scenarios import list_scenarios
from lmshealth.life.prognosis import Prognosis
from lmshealth.stage.degradation_laws import AnyLaw, HertzWear, Linear, Loosening, Power, Unchanging
from lmshealth.stage.description import ParameterSpec, ScatterPrior, Stage
from lmshealth.stage.priors import Lognormal, Normal, Uniform
from lmshealth.tracking.history import History
from tests.lives import (
    FREQUENCY,
    LAWS_ALONE,
    PRELOAD,
    SEEN_BY_NONE,
    STILL_MOUNT,
    make_history,
    make_stage,
    since,
    true_drift,
)
from tests.lives import make_prognosis as prognosis_with

NONE = '{ kind = "none" }'
WEAR_OR_NOT = PRELOAD.replace("law = {", "law = [{").replace("} }\n", "} }, " + NONE + "]\n")
# Which no mode sees, though it has a limit and a law.
LIMITED_FOOT = SEEN_BY_NONE + (
    "limit = { below = 0.8 }\n"
    'law = { kind = "hertz-wear", life_km = { kind = "lognormal", median = 8000, sigma = 1.0 } }\n'
)
N = 4000
FLAT = np.zeros((1, 1))
WALKS, SCALES, DEVIATIONS = (0.2,) * 5, (0.9, 0.07, 0.03), (0.6, 0.3, 0.1)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Preload that wears or not, under a mount that keeps its stiffness."""
    folder = tmp_path_factory.mktemp("stage")
    return make_stage(folder, (WEAR_OR_NOT, STILL_MOUNT), tail=LAWS_ALONE)


def gaussian(z: float, error: float) -> FloatArray:
    """Make evenly spread draws of a pace that was measured to be z, with some error."""
    width = 1 / np.sqrt(1 + 1 / error**2)
    levels = (np.arange(N) + 0.5) / N
    return np.asarray(stats.norm(z * width**2 / error**2, width).ppf(levels))


def scattering(walk: tuple[float, ...] = WALKS) -> dict[str, tuple[LawEvidence, ...]]:
    """Make the evidence of a machine on scatter: on the walk alone."""
    after = {"walk": walk, "noise_scale": SCALES, "deviation": DEVIATIONS}
    before = {"walk": WALKS, "noise_scale": SCALES, "deviation": DEVIATIONS}
    return {
        name: tuple(LawEvidence(b, a, FLAT) for b, a in zip(before[name], after[name], strict=True))
        for name in before
    }


def measured(
    z: float, error: float, wears: float = 0.5, *, pace_informed: float = 0.9
) -> MachineEvidence:
    """Make the evidence of a machine with a measured pace, if it wears."""
    pace = pace_likelihood(gaussian(z, error), np.full(N, 1 / N))
    laws = {
        "guide_preload": {
            "hertz-wear": LawEvidence(0.5, wears, pace),
            "none": LawEvidence(0.5, 1 - wears, FLAT),
        },
        "mount_stiffness": {"none": LawEvidence(1.0, 1.0, FLAT)},
    }
    return MachineEvidence(laws, scattering(), pace_informed)


def silent() -> MachineEvidence:
    """Make the evidence of a machine without any information."""
    pace = np.zeros_like(measured(0.0, 1.0).laws["guide_preload"]["hertz-wear"].pace)
    preload = {"hertz-wear": LawEvidence(0.5, 0.5, pace), "none": LawEvidence(0.5, 0.5, FLAT)}
    still = {"none": LawEvidence(1.0, 1.0, FLAT)}
    return MachineEvidence({"guide_preload": preload, "mount_stiffness": still}, scattering(), 0.0)


def wear_of(priors: FleetPrior) -> tuple[float, Lognormal]:
    """Return the fleet's share of machines that wear, and the prior of their lives."""
    law = priors.laws[0]
    assert law.kind == "hertz-wear"
    assert law.pace is not None
    assert isinstance(law.pace[1], Lognormal)
    return law.share[1], law.pace[1]


def prior_from(others: Mapping[str, MachineEvidence], stage: Stage) -> tuple[float, Lognormal]:
    """Return the prior of a machine without information from other machines."""
    return wear_of(fleet_priors(stage, dict(others) | {"new": silent()})["new"])


@pytest.mark.parametrize(("z", "error"), [(0.3, 0.2), (-1.5, 0.4), (1.0, 2.0)])
def test_likelihood_of_a_fleet_is_that_of_the_textbook(z: float, error: float) -> None:
    """With Gaussian measurements data have the density N(z; m, v + e²) over N(z; 0, 1 + e²)."""
    found = pace_likelihood(gaussian(z, error), np.full(N, 1 / N))
    mean, variance = constants.FLEET_MEAN, constants.FLEET_VARIANCE
    expected = np.asarray(stats.norm(mean, np.sqrt(variance + error**2)).logpdf(z))
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
def test_fleet_prior_is_that_of_dense_integration(stage: Stage) -> None:
    """Median, sigma and share are those of the hierarchical model integrated independently."""
    z = np.array([0.9, 1.4, 1.1, 0.4, 1.8, 1.2])
    errors = np.array([0.1, 0.3, 0.2, 0.5, 0.3, 0.1])
    wears = np.array([0.99, 0.9, 0.6, 0.8, 0.9, 0.95])
    pairs = zip(z, errors, wears, strict=True)
    others = {str(k): measured(*three) for k, three in enumerate(pairs)}
    share, prior = prior_from(others, stage)
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
    # Priors have two digits.
    assert share == pytest.approx(expected_share, rel=0.02)
    assert np.log(prior.median / 8000) == pytest.approx(mean, abs=0.06)
    assert prior.sigma == pytest.approx(std, rel=0.03)


def test_few_machines_leave_the_description(stage: Stage) -> None:
    """Two other machines give no prior; three do."""
    others = {str(k): measured(1.0, 0.1) for k in range(3)}
    assert fleet_priors(stage, {"new": silent()}) == {}
    two = {name: others[name] for name in ("0", "1")}
    assert fleet_priors(stage, two | {"new": silent()}) == {}
    assert set(fleet_priors(stage, others | {"new": silent()})) == {"new"}


@pytest.mark.slow
def test_one_law_beside_the_free_change_is_one_of_two(
    tmp_path: Path,
) -> None:
    """Machines that do not follow it lower its share, and have no say about its pace."""
    stage = make_stage(tmp_path, (PRELOAD,), tail="[life]\nfree = 0.1\n")
    prior = scatter_prior(stage)
    scatter = {
        name: tuple(LawEvidence(p, p, FLAT) for p in getattr(prior, name)) for name in scattering()
    }

    def evidence(z: float, follows: float) -> MachineEvidence:
        pace = pace_likelihood(gaussian(z, 0.2), np.full(N, 1 / N))
        laws = {"guide_preload": {"hertz-wear": LawEvidence(0.9, follows, pace)}}
        return MachineEvidence(laws, scatter, 0.0)

    good = {f"m{k}": evidence(0.5, 1.0) for k in range(4)}
    odd = {f"x{k}": evidence(-3.0, 0.0) for k in range(4)}
    paces = [fleet_priors(stage, own)["m0"].laws[0].pace for own in (good, good | odd)]
    assert paces[0] is not None
    assert paces[0] == paces[1]


def test_machines_without_information_keep_the_description(stage: Stage) -> None:
    """However many there are, the prior is the description's."""
    priors = fleet_priors(stage, {str(k): silent() for k in range(30)})
    assert len(priors) == 30
    share, prior = wear_of(priors["7"])
    assert share == 0.5
    assert prior == Lognormal(8000, 1.0)
    assert priors["7"].scatter == ScatterPrior(WALKS, SCALES, DEVIATIONS)


@pytest.mark.slow
def test_scatter_of_a_fleet_is_estimated(stage: Stage) -> None:
    """If all machines have one walk it is probable for another machine, and no other value is."""
    walks = (0.01, 0.02, 0.9, 0.05, 0.02)
    others = {str(k): replace(silent(), scatter=scattering(walks)) for k in range(20)}
    priors = fleet_priors(stage, others | {"new": silent()})["new"]
    updated = priors.apply_to(stage)
    assert updated.scatter == priors.scatter
    assert priors.scatter.walk[2] > 0.7
    assert max(priors.scatter.walk[k] for k in (0, 1, 3, 4)) < 0.15
    assert priors.scatter.noise_scale == SCALES
    history = lived(np.linspace(0.0, 2e6, 8), 4000.0)
    before, after = (LifeLikelihood.of(history, one).grid for one in (stage, updated))
    k = np.searchsorted(np.unique(before.walk), before.walk)
    walk = np.array(priors.scatter.walk) / np.sum(priors.scatter.walk)
    expected = np.log(walk / scatter_prior(stage).walk)[k]
    np.testing.assert_allclose(after.log_weight - before.log_weight, expected, atol=1e-9)


@pytest.mark.slow
def test_a_machine_does_not_change_its_own_prior(stage: Stage) -> None:
    """The evidence of a machine changes the priors of others, and not its own."""
    others = {str(k): measured(0.2 * k, 0.2, 0.9) for k in range(6)}
    slow = others | {"a": measured(2.0, 0.5, 0.9, pace_informed=0.1), "b": silent()}
    fast = others | {"a": measured(-2.0, 0.5, 0.1, pace_informed=0.1), "b": silent()}
    of_slow, of_fast = fleet_priors(stage, slow), fleet_priors(stage, fast)
    assert of_slow["a"] == of_fast["a"]
    assert of_slow["a"].n_machines == 7
    assert wear_of(of_slow["b"])[1].median > wear_of(of_fast["b"])[1].median
    assert wear_of(of_slow["b"])[0] > wear_of(of_fast["b"])[0]


def test_order_of_machines_does_not_matter(stage: Stage) -> None:
    """The order of the machines does not change a bit of the priors."""
    evidence = {str(k): measured(0.3 * k - 1, 0.3, 0.1 + 0.08 * k) for k in range(8)}
    evidence |= {"new": silent(), "other": silent()}
    backward = dict(reversed(evidence.items()))
    assert fleet_priors(stage, evidence) == fleet_priors(stage, backward)


def test_machines_without_wear_make_lives_longer(stage: Stage) -> None:
    """Machines without wear lower the share that wears and lengthen lives."""
    worn = {f"worn-{k}": measured(-1.0 + 0.2 * k, 0.1, 0.99) for k in range(6)}
    share, prior = prior_from(worn, stage)
    # Sound after a long way: if they wear at all, then slowly.
    slow = gaussian(0.0, 10.0)
    slow = slow[slow > 0.5]
    pace = pace_likelihood(slow, np.full(slow.size, 1 / slow.size))
    sound = measured(0.0, 1.0)
    preload = {"hertz-wear": LawEvidence(0.5, 0.3, pace), "none": LawEvidence(0.5, 0.7, FLAT)}
    sound = replace(sound, laws=sound.laws | {"guide_preload": preload})
    more, longer = prior_from(worn | {f"sound-{k}": sound for k in range(6)}, stage)
    assert more < share - 0.1
    assert longer.median > 1.2 * prior.median


def test_evidence_and_priors_survive_packing(stage: Stage) -> None:
    """Both come back unchanged, and the evidence of a machine is small."""
    evidence = measured(0.5, 0.3)
    content = pack(evidence)
    back = unpack(content, MachineEvidence)
    assert pack(back) == content
    preload = back.laws["guide_preload"]["hertz-wear"]
    np.testing.assert_array_equal(preload.pace, evidence.laws["guide_preload"]["hertz-wear"].pace)
    assert len(content) < 30_000
    priors = fleet_priors(stage, {str(k): measured(1.0, 0.2) for k in range(4)} | {"new": silent()})
    assert unpack(pack(priors["new"]), FleetPrior) == priors["new"]


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
def test_laws_with_a_fleet_prior_are_laws_of_a_description(
    stage: Stage, law: AnyLaw, field: str
) -> None:
    """Of every kind: only the prior of its pace changes, in a form that a description can have."""
    other = Unchanging() if law.names else HertzWear(life_km=Lognormal(8000, 1.0))
    spec = ParameterSpec(name="guide_preload", prior=Lognormal(1.0, 0.3), law=(law, other))
    own = replace(stage, description=msgspec.structs.replace(stage.description, parameter=(spec,)))
    pace = measured(0.8, 0.2).laws["guide_preload"]["hertz-wear"].pace

    def preload(one: AnyLaw, after: float) -> LawEvidence:
        return LawEvidence(0.5, after, pace if fleet._pace_field(one) else FLAT)

    laws = {"guide_preload": {law.kind: preload(law, 0.8), other.kind: preload(other, 0.2)}}
    priors = fleet_priors(
        own, {str(k): MachineEvidence(laws, scattering(), 0.1) for k in range(5)}
    )["3"]
    updated = priors.apply_to(own)
    found = updated.parameters[0].laws[0]
    assert priors.laws[0].field == field
    assert found.weight > 0.6
    changed = {name for name in law.__struct_fields__ if getattr(found, name) != getattr(law, name)}
    assert changed == {"weight", *([field] if field else [])}
    written = msgspec.json.encode(updated.parameters[0])
    assert msgspec.json.decode(written, type=ParameterSpec).laws[0] == found
    weights = [scenario.weight for scenario in list_scenarios(updated.parameters, (), 1e6, 0.05)]
    assert sum(weights) == pytest.approx(1.0)
    if field:
        before, after = getattr(law, field), getattr(found, field)
        assert after.quantile(0.5) > before.quantile(0.5)
        assert np.diff(after.quantile([0.1, 0.9])) < np.diff(before.quantile([0.1, 0.9])) * 2.5


def test_a_stage_with_a_fleet_prior_has_its_own_digest(stage: Stage) -> None:
    """Other teaching is another digest, the same teaching the same one."""
    evidence = {str(k): measured(1.0, 0.2) for k in range(4)} | {"new": silent()}
    priors = fleet_priors(stage, evidence)["new"]
    updated = priors.apply_to(stage)
    assert updated.digest != stage.digest
    assert priors.apply_to(stage).digest == updated.digest
    other = fleet_priors(stage, evidence | {"0": measured(-2.0, 0.1)})["new"].apply_to(stage)
    assert other.digest not in (stage.digest, updated.digest)
    assert updated.modal_map is stage.modal_map


def test_priors_have_two_digits(stage: Stage) -> None:
    """A little more evidence of one machine changes no prior."""
    evidence = {str(k): measured(1.0, 0.2) for k in range(9)} | {"new": silent()}
    moved = evidence | {"0": measured(1.0005, 0.2)}
    assert fleet_priors(stage, moved)["new"] == fleet_priors(stage, evidence)["new"]


@pytest.fixture(scope="module")
def small_grid() -> Iterator[None]:
    """Average over one walk and no deviation: evidence is computed alike for any."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "WALK_STDS", (1e-5,))
        patch.setattr(constants, "WALK_PRIOR", (1.0,))
        patch.setattr(constants, "LONE_WALKS", ((1e-5, 1.0),))
        patch.setattr(constants, "NOISE_SCALES", (1.0,))
        patch.setattr(constants, "NOISE_SCALE_PRIOR", (1.0,))
        patch.setattr(constants, "DEVIATION_STDS", (0.0,))
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
    return fit_life(history, stage, 5, chains=False)


def test_a_machine_needs_the_fleet_prior_until_its_life_is_informed(
    small_grid: None, stage: Stage
) -> None:
    """A life of 4,000 km is informed after 2,000 km, and not after 40 km."""
    old = machine_evidence(stage, fitted(lived(np.linspace(0.0, 2e6, 12), 4000.0), stage))
    new = machine_evidence(stage, fitted(lived(np.linspace(0.0, 4e4, 6), 4000.0), stage))
    assert not needs_fleet_prior(old)
    assert old.pace_informed > 0.95
    assert needs_fleet_prior(new)
    assert new.pace_informed < 0.3
    assert len(pack(old)) < 30_000


def test_evidence_is_that_of_the_posterior(small_grid: None, stage: Stage) -> None:
    """Probabilities of laws are those of the posterior, and the likeliest fleet has its life."""
    posterior = fitted(lived(np.linspace(0.0, 2e6, 12), 4000.0), stage)
    preload = machine_evidence(stage, posterior).laws
    laws = posterior.laws("guide_preload")
    for kind, one in preload["guide_preload"].items():
        assert one.prior == 0.5
        assert one.posterior == pytest.approx(laws.get((kind, 0.0), 0.0))
    assert preload["mount_stiffness"]["none"].posterior == pytest.approx(1.0)
    pace = preload["guide_preload"]["hertz-wear"].pace
    best = float(constants.FLEET_MEAN[np.argmax(pace[:, 0]), 0])
    assert 8000 * np.exp(best) == pytest.approx(4000, rel=0.25)


def test_a_free_change_has_its_share_of_the_prior_and_no_evidence_of_its_own(
    small_grid: None, tmp_path: Path
) -> None:
    """Laws of the description have what the free change leaves them, before and after."""
    free = make_stage(tmp_path, (WEAR_OR_NOT, STILL_MOUNT), tail="[life]\nfree = 0.2\n")
    posterior = fitted(lived(np.linspace(0.0, 2e6, 12), 4000.0), free)
    evidence = machine_evidence(free, posterior)
    preload, laws = evidence.laws["guide_preload"], posterior.laws("guide_preload")
    assert set(preload) == {"hertz-wear", "none"}
    assert [one.prior for one in preload.values()] == pytest.approx([0.4, 0.4])
    for kind, one in preload.items():
        assert one.posterior == pytest.approx(laws.get((kind, 0.0), 0.0))
    for own in evidence.scatter.values():
        assert sum(one.posterior for one in own) == pytest.approx(1, abs=1e-9)


def test_a_machine_that_wanders_is_little_evidence_on_walks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a wander of all modes is probable, walks keep their prior."""
    monkeypatch.setattr(constants, "WALK_STDS", (1e-5, 1e-3, 5e-3))
    monkeypatch.setattr(constants, "WALK_PRIOR", (0.4, 0.3, 0.3))
    stage = make_stage(tmp_path, (WEAR_OR_NOT,), n_modes=3, tail="[life]\ncommon_wander = 0.4\n")
    rng = np.random.default_rng(4)
    together = 3e-3 * rng.multivariate_normal(np.zeros(24), common_kernel(np.arange(24)))
    noise = 3e-4 * rng.standard_normal((24, 3))
    posterior = fitted(make_history(np.log(FREQUENCY) + together[:, None] + noise, std=3e-4), stage)
    scatter = machine_evidence(stage, posterior).scatter
    for own in scatter.values():
        assert sum(one.posterior for one in own) == pytest.approx(1, abs=1e-9)
    assert [one.posterior / one.prior for one in scatter["walk"]] == pytest.approx([1] * 3, abs=0.3)


def test_a_law_that_is_ruled_out_changes_its_share_alone(small_grid: None, stage: Stage) -> None:
    """A part that keeps its health is evidence for few that wear, and none on their pace."""
    still = machine_evidence(stage, fitted(lived(np.linspace(0.0, 4e6, 12), 1e9), stage))
    preload = still.laws["guide_preload"]["hertz-wear"]
    assert preload.posterior < 0.05
    ruled_out = replace(preload, posterior=0.0, pace=np.zeros_like(preload.pace))
    laws = {"hertz-wear": ruled_out, "none": LawEvidence(0.5, 1.0, FLAT)}
    sound = replace(still, laws=still.laws | {"guide_preload": laws}, pace_informed=0.0)
    share, prior = wear_of(fleet_priors(stage, {str(k): sound for k in range(5)})["0"])
    assert share < 0.2
    assert prior == Lognormal(8000, 1.0)


@pytest.mark.usefixtures("small_grid")
def test_an_unidentifiable_limit_needs_no_fleet_prior(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part that the modes cannot see stays unknown for ever: that is no question of age."""
    monkeypatch.setattr("lmshealth.stage.constants.MAP_ERRORS", ((1.0, 1.0),))
    blind = make_stage(tmp_path, (PRELOAD, STILL_MOUNT, LIMITED_FOOT), tail=LAWS_ALONE)
    posterior = fitted(lived(np.linspace(0.0, 2e6, 12), 4000.0), blind)
    evidence = machine_evidence(blind, posterior)
    assert not needs_fleet_prior(evidence)
    # Nor has such a machine evidence on it: 0.50 with a Monte-Carlo error of 0.04 over eight seeds.
    assert np.abs(evidence.laws["foot"]["hertz-wear"].pace[15:26, 4:]).max() < 0.5 + 4 * 0.04


# Calibration by ended lives


def lives_at(places: FloatArray) -> list[EndedLife]:
    """Make ended lives with ends at some places of what was predicted."""
    return [EndedLife(place, reached=True) for place in places.tolist()]


def predicted(remaining: FloatArray) -> Prognosis:
    """Make a prognosis with draws of the remaining travel in m."""
    return prognosis_with(remaining, np.full(remaining.size, 1e4))


def test_calibration_needs_as_many_lives_as_support_it() -> None:
    """Nine lives support nine in ten, eight do not; one that ended before all draws, no travel."""
    own = predicted(np.linspace(1e5, 1e6, 1001))
    assert calibrate(own, lives_at(np.full(8, 0.3))) is None
    found = calibrate(own, lives_at(np.r_[0.02, np.full(8, 0.3)]))
    assert found is not None
    assert (found.n_lives, found.coverage) == (9, pytest.approx(0.9))
    assert found.travel == pytest.approx(1.18e5, rel=0.01)
    none = calibrate(own, lives_at(np.r_[0.0, np.full(8, 0.3)]))
    assert none is not None and none.travel == 0.0
    far = calibrate(predicted(np.full(100, 2e7)), lives_at(np.full(9, 0.3)))
    assert far is not None and np.isinf(far.travel)


@pytest.mark.slow
@pytest.mark.parametrize("n", [9, 25])
def test_calibrated_travel_is_outlived_as_often_as_stated(n: int) -> None:
    """Whatever the law of places; a quantile of the prognosis itself is outlived far less often."""
    rng, own = np.random.default_rng(n), predicted(np.linspace(0.0, 1e6, 5001))
    stated, kept, by_model = 0.0, [], []
    for _ in range(800):
        *places, new = rng.beta(0.7, 2.0, n + 1)  # ends come far sooner than predicted
        found = calibrate(own, lives_at(np.array(places)))
        assert found is not None
        stated = found.coverage
        kept.append(1e6 * new >= found.travel)
        by_model.append(1e6 * new >= 1e5)
    assert abs(np.mean(kept) - stated) < 4 * np.sqrt(stated * (1 - stated) / 800)
    assert np.mean(by_model) < 0.8


def test_a_life_ends_at_the_work_by_the_clock_of_its_description(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not at a baseline that is flagged later; and a life with a singular matrix is left out."""
    work = (since("reset", 8, 14), since("reset", 12, 14))
    history = replace(lived(np.linspace(0.0, 1.3e6, 14), 4000.0), steps=work)
    by_days = msgspec.structs.replace(
        stage.description,
        life=msgspec.structs.replace(stage.description.life, clock="days"),
        usage=msgspec.structs.replace(stage.description.usage, km_per_day=10.0),
    )
    asked: list[tuple[int, float]] = []

    def prognosed(own: History, *_: object, **__: object) -> Prognosis:
        asked.append((len(own.logs), float(own.travel[-1])))
        if len(asked) == 1:
            raise np.linalg.LinAlgError("singular")
        return predicted(np.linspace(1e5, 1e6, 101))

    monkeypatch.setattr(fleet, "prognose", prognosed)
    found = ended_lives(
        replace(history, baselines=(0, 9, 13)), replace(stage, description=by_days), 1
    )
    assert len(found) <= 1
    # A log a week.
    assert asked[:2] == [(8, 7 * 7 * 1e4), (12, 11 * 7 * 1e4)]


@pytest.mark.slow
def test_the_end_of_a_life_is_placed_in_what_was_predicted_of_it(
    small_grid: None, stage: Stage
) -> None:
    """A life whose limit was passed before the repair is reached; one serviced early is not."""
    travel = np.linspace(0.0, 1.3e6, 14)
    for life_km, reached in ((4000.0, True), (9000.0, False)):
        worn = lived(travel, life_km)
        history = replace(worn, baselines=(0, 13))
        (found,) = ended_lives(history, stage, 1)
        assert found.reached is reached
        assert 0.0 <= found.place < 0.9
    assert ended_lives(worn, stage, 1) == ()
    assert ended_lives(replace(worn, baselines=(0, 2)), stage, 1) == ()
