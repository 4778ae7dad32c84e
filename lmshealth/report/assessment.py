"""Everything that is said about a stage, in one noun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lmshealth.health.results import Health
from lmshealth.health.verdict import Verdict, undeclared_events
from lmshealth.io.log import Refusal
from lmshealth.prognosis.fleet_prior import FleetPrior, MachineEvidence
from lmshealth.prognosis.maintenance_decision import Service, decide
from lmshealth.prognosis.results import Prognosis
from lmshealth.signal.waterfall import Waterfall
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """All results of one stage, as far as the data carried them.

    Attributes
    ----------
    stage : Stage
        The description the logs were read with.
    history : History
        Modal estimates of all logs.
    digests : tuple of str
        SHA-256 of each log of the history.
    track : Track or None
        None when no log gave a tracked mode.
    health : Health or None
        None when there is no health parameter, or too few logs.
    prognosis : Prognosis or None
        None when there is no health, or no limit.
    judgement : Verdict
        The verdict.
    refused : tuple of Refusal
        Everything of this stage that was not analysed.
    notes : tuple of str
        What the reader must know beside the numbers, one sentence each.
    seed : int
        Of all random streams.
    waterfall : Waterfall or None
        Spectra of the logs of the history; None where no log shows the band of its modes.
    evidence : MachineEvidence or None
        What the machine teaches others of its description; None without a posterior of its life.
    fleet : FleetPrior or None
        The prior that others have taught it; None where the prognosis rests on the description's.
    """

    stage: Stage
    history: History
    digests: tuple[str, ...]
    track: Track | None
    health: Health | None
    prognosis: Prognosis | None
    judgement: Verdict
    refused: tuple[Refusal, ...]
    notes: tuple[str, ...]
    seed: int
    waterfall: Waterfall | None = None
    evidence: MachineEvidence | None = None
    fleet: FleetPrior | None = None

    def service(self) -> Service:
        """Choose the day of the service as the description asks."""
        return decide(self.prognosis, self.stage.description.decision)

    @property
    def alarmed(self) -> tuple[str, ...]:
        """The modes that raised an alarm since the baseline, where no verdict says why."""
        if self.judgement.verdict != "not-enough-data":
            return ()
        alarms = undeclared_events(self.track, self.history.baseline, "alarm")
        return tuple(dict.fromkeys(event.mode for event in alarms))

    def urgency(self, service: Service) -> tuple[int, float, float, str]:
        """Give a key that sorts by risk: days until the service; unknown before safe."""
        identity, verdict = self.judgement.stage, self.judgement.verdict
        if verdict == "not-enough-data":
            return (0 if self.alarmed else 1), 0.0, 0.0, identity
        if self.prognosis is None:
            return (1 if verdict == "healthy" else 0), 0.0, 0.0, identity
        days = service.wait
        group = 2 if verdict == "healthy" and np.isinf(days) else 0
        return group, days, float(self.prognosis.beyond_horizon()[-1]), identity
