"""Lives of the simulated Y stage whose laws are drawn from the priors of its description."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lmshealth.stage.degradation_laws import HertzWear as WearLaw
from lmshealth.stage.degradation_laws import Loosening as LooseningLaw
from lmshealth.stage.description import ParameterSpec, load_stage
from models.lives.degradation import HertzWear, Law, Life, Loosening, Steady
from models.lives.simulation import Plan

STAGE, N_LOGS, SECONDS = "lms-y", 30, 20.0
# Beyond the map, which nobody can be asked about: the last odometer of any life in km, and how
# little may be left there.
_LAST_KM, _LEAST = 2000.0, 0.26


@dataclass(frozen=True, slots=True)
class PriorPlan(Plan):
    """A life whose laws are those of the stage description, drawn from its priors."""

    def draw_life(self) -> Life:
        """Return the life with the laws of this seed; one that leaves the map is drawn again."""
        rng = self.rng("laws")
        preload, mount = load_stage(self.stage).parameters
        while True:
            life = Life(self.life, preload=_law(rng, preload), mount=_law(rng, mount))
            if min(life.preload.at(_LAST_KM), life.mount.at(_LAST_KM)) > _LEAST:
                return life


def plan_of(seed: int, logs: int = N_LOGS, seconds: float = SECONDS) -> PriorPlan:
    """Plan the life of a seed."""
    return PriorPlan(STAGE, "by-prior", logs, seconds, seed)


def _law(rng: np.random.Generator, parameter: ParameterSpec) -> Law:
    """Draw which law a parameter follows, and its parameters."""
    weight = np.array([law.weight for law in parameter.laws])
    law = parameter.laws[rng.choice(weight.size, p=weight / weight.sum())]
    first, second = rng.uniform(size=2)
    if isinstance(law, WearLaw):
        return HertzWear(float(law.life_km.quantile(first)), float(law.exponent.quantile(second)))
    if isinstance(law, LooseningLaw):
        return Loosening(float(law.life_km.quantile(first)), float(law.floor.quantile(second)))
    return Steady()
