"""What fleet_prior claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, covered, measured, percents

STEP = "prognose, young machines"


def result(answer: Row) -> Iterator[Claim]:
    """Claim what a fleet teaches its young machines."""
    ways = answer["ways"]
    own, learned = ways["description"], ways["learned"]
    gain = own["crps_km_over_learned"]
    score = measured(learned["crps_km"], "km")
    yield Claim(
        f"score (CRPS) of the remaining life of {answer['young']} young machines",
        *score,
        f"{measured(own['crps_km'], 'km')[0]} by the description, "
        f"{' '.join(measured(gain, 'km'))} more",
        gain[0] > 0,
    )
    yield Claim(
        "of it lost to who knows the fleet",
        *measured(learned["lost_km"], "km"),
        f"{' '.join(measured(own['lost_km'], 'km'))} by the description",
        learned["lost_km"][0] < own["lost_km"][0],
    )
    yield covered(
        "intervals of 90 % cover, by the learned prior",
        learned["coverage"][1:],
        f"50 %: {percents([learned['coverage'][0]['share']])}",
    )
    for way in ("only the worn teach", "another fleet teaches"):
        wrong = ways[way]
        yield Claim(
            f"lost if {way} (control)",
            *measured(wrong["lost_km"], "km"),
            f"90 % intervals cover {percents([wrong['coverage'][1]['share']])}",
            wrong["lost_km"][0] > learned["lost_km"][0],
        )
