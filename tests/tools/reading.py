"""Draw the pictures of how-to-read.html: one healthy and one worn simulated stage.

`python -m tests.tools.reading` simulates and analyses both lives, in about four minutes, and
writes ``lmshealth/report/templates/reading/*.svg``. With two folders, of a healthy and of a worn
machine, it draws these results of `lmshealth run`.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from lmshealth._private.serialize import unpack
from lmshealth.batch.store import Store, default_url
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.summary import limit_of
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.report import figures, log_figures
from lmshealth.tracking.track import covariate_shifts, find_covariate_effects
from studies.harness.command_line import ROOT, call

FOLDER = ROOT / "lmshealth" / "report" / "templates" / "reading"
LIVES = {"healthy": ("healthy", 4), "worn": ("both", 3)}  # name of the life, and seed
MODE, PARAMETER, COVARIATE, CHANNEL = "pitch", "guide_preload", "temperature_c", "delta_e"
_REST = r"(?:(?!</?g\b).)*"  # without a group
HINT = re.compile(rf'(?s)<g class="hint"{_REST}(?:<g\b{_REST}</g>{_REST})*</g>\n?')

Draw = Callable[[Any], object]


def main(*results: Path) -> None:
    """Write one picture of each kind, the healthy machine above the worn one."""
    with tempfile.TemporaryDirectory() as folder:
        found = results or tuple(analysed(Path(folder), name) for name in LIVES)
        pairs = [pictures(assessment_in(result)) for result in found]
    for key, (draw, size) in pairs[0].items():
        write(key, [draw, pairs[1][key][0]], size)


def analysed(folder: Path, name: str) -> Path:
    """Simulate and analyse a life; return the folder of its results."""
    life, seed = LIVES[name]
    logs, out = folder / name, folder / f"{name}-result"
    call("models", "simulate", "lms-y", "--life", life, "--logs", 40, "--seconds", 20,
         "--seed", seed, "--out", logs, quick=False)  # fmt: skip
    call("lmshealth", "run", logs, "--stage", "lms-y", "--out", out, quick=False)
    return out


def assessment_in(result: Path) -> Assessment:
    """Return the assessment of the only machine in a folder of results."""
    with closing(Store(default_url(result), create=False)) as store:
        (machine,) = store.published()
        content = store.get("assessed", machine.key, machine.machine)
        assert content is not None
        found: Assessment = unpack(content, Assessment)
    return found


def pictures(made: Assessment) -> dict[str, tuple[Draw, tuple[float, float]]]:
    """Return what draws each kind of picture in a figure, and its size in inches."""
    track, history, health, prognosis = made.track, made.history, made.latest_health, made.prognosis
    latest, before = made.latest, made.at_baseline
    assert track and health and prognosis and latest and before
    spectra = one_channel(latest).spectra
    assert made.waterfall and spectra and latest.shapes and before.shapes
    limit = next(limit_of(spec) for spec in made.stage.parameters if spec.name == PARAMETER)
    effects = find_covariate_effects(history, track, made.stage)
    effect = next(one for one in effects if (one.covariate, one.mode) == (COVARIATE, MODE))
    lives: dict[str, Any] = {"history": history, "track": track}
    moved = covariate_shifts(history, track, made.stage)
    single: dict[str, Draw] = {
        "waterfall": partial(
            figures.plot_waterfall, waterfall=made.waterfall, moved=moved, **lives
        ),
        "frequency": partial(figures.plot_frequencies, mode=MODE, **lives),
        "damping": partial(figures.plot_damping, mode=MODE, **lives),
        "influence": partial(figures.plot_influence, influence=effect, history=history),
        "posterior": partial(
            figures.plot_posterior, health=health, parameters=health.parameters[:2]
        ),
        "health": partial(figures.plot_health, health=health, parameter=PARAMETER, limit=limit),
        "life": partial(figures.plot_life, prognosis=prognosis, parameter=PARAMETER),
        "survival": partial(
            figures.plot_survival, prognosis=prognosis, service=made.service()
        ),
        "nis": partial(figures.plot_nis, track=track),
    }  # fmt: skip
    spectrum = partial(
        log_figures.plot_spectra, summary=spectra, modes=latest.modes,
        stage=made.stage, before=one_channel(before),
    )  # fmt: skip
    shapes = partial(
        log_figures.plot_shapes, shapes=latest.shapes, stage=made.stage, before=before.shapes
    )
    whole = {"spectrum": (spectrum, (8.0, 3.3)), "shapes": (shapes, (8.0, 2.1))}
    return whole | {
        key: (partial(alone, draw), (figures.SIZE[0], 0.9 * figures.SIZE[1]))
        for key, draw in single.items()
    }


def alone(draw: Draw, figure: Any) -> None:
    """Draw in the only axes of a figure."""
    draw(figure.add_subplot())


def one_channel(found: LogEstimates) -> LogEstimates:
    """Return the estimates of a log with the spectrum of one channel."""
    spectra = found.spectra
    assert spectra
    k = spectra.channels.index(CHANNEL)
    cut = replace(
        spectra, channels=(CHANNEL,), derived=spectra.derived[k : k + 1],
        level=spectra.level[k : k + 1], fitted=spectra.fitted[k : k + 1],
    )  # fmt: skip
    return replace(found, spectra=cut)


def write(key: str, draws: list[Draw], size: tuple[float, float]) -> None:
    """Write the pictures of both machines one below the other, without hints, on paper."""

    def both(figure: Any) -> None:
        for part, name, draw in zip(figure.subfigures(2), LIVES, draws, strict=True):
            part.suptitle(name, x=0.01, ha="left", size=11, weight="bold")
            draw(part)

    text = figures.inline(both, salt=key, size=(size[0], 2 * size[1] + 0.5))
    text = HINT.sub("", text).replace(">\n<", "><")
    text = text.replace("<svg ", '<svg style="background:var(--card,#ffffff)" ', 1)
    (FOLDER / f"{key}.svg").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
