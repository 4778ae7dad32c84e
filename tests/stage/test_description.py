"""Stage descriptions: schema errors name their key, maps are checked, logs find their stage."""

from __future__ import annotations

import json
import pickle
import re
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import structs

from lmshealth.errors import BadQuestion, BadStage, OutsideMap
from lmshealth.io.log import Metadata
from lmshealth.report.tables import stage_rows
from lmshealth.stage.check import check_stage, diagnose
from lmshealth.stage.degradation_laws import Free, Unchanging
from lmshealth.stage.description import ModeSpec, Stage, load_stage, search_offset, shipped
from lmshealth.stage.identifiability import plan
from lmshealth.stage.modal_map import read_map
from tests.lives import FADING, FOOT, MOUNT, PRELOAD, make_stage, map_rows, stage_text, true_drift


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    """Preload and mount, two modes."""
    return make_stage(tmp_path)


def write_map(folder: Path) -> None:
    """Write a full map."""
    (folder / "map.csv").write_text("\n".join(map_rows(("guide_preload", "mount_stiffness"))))


def load(folder: Path, text: str) -> Stage:
    """Write a description and a full map, and load it."""
    write_map(folder)
    path = folder / "odd.toml"
    path.write_text(text)
    return load_stage(str(path))


@pytest.mark.parametrize(
    ("old", "new", "needle"),
    [
        (
            "damping_ratio = 0.018",
            "damping_ratio = 1.8",
            r"mode\[0\]\.damping_ratio: needed a number from 1e-07 to 0.99, got 1.8",
        ),
        ("damping_ratio = 0.015", "damping = 0.015", r"mode\[1\]\.damping: unknown key"),
        ("frequency_hz = 136.6\n", "", r"mode\[1\]\.frequency_hz: missing"),
        ("= 126.4", "= inf", r"mode\[0\]\.frequency_hz: .*got inf"),
        ("sigma = 0.3", 'sigma = "wide"', r"parameter\[0\]\.prior\.sigma"),
        (
            '"hertz-wear"',
            '"rust"',
            r"parameter\[0\]\.law\.kind: there are hertz-wear, loo",
        ),
        ("below = 0.6", "below = -1", r"parameter\[0\]\.limit\.below"),
        ("floor = {", "flor = {", r"parameter\[1\]\.law\.flor: .*kind, life_km, floor"),
        ("model_std = 0.05", "model_std = 1.5", r"map\.model_std"),
        ("prior_std = 0.001", "prior_std = 0", r"covariate\[0\]\.prior_std"),
        ("reference = 21.0", "referense = 21.0", r"covariate\[0\]\.referense"),
        ('name = "small"', 'nam = "small"', "nam: unknown key"),
        (
            "median = 1.0, sigma = 0.3",
            "median = -1.0, sigma = 0.3",
            r"parameter\[0\]\.prior\.median: needed a number from 1e-12 to 1e.12, got -1",
        ),
        (
            'name = "pitch"',
            'name = "roll"',
            r"\.toml: \[\[mode\]\] names must be unique.*roll",
        ),
        (
            "[map]",
            '[[channel]]\nname = "a"\nposition_m = [0, 0, 1]\ndirection = [0, 0, 0]\n[map]',
            r"channel\[0\]: the direction of a has no length",
        ),
        (
            'name = "mount_stiffness"',
            'name = "guide_preload"',
            r"\.toml: \[\[parameter\]\].*unique",
        ),
        (
            '[map]\nfile = "map.csv"\nmodel_std = 0.05',
            "",
            r"\.toml: \[\[parameter\]\] needs a \[map\]",
        ),
        ('file = "map.csv"', 'file = "gone.csv"', r"map\.file: .*gone\.csv"),
        (
            "below = 0.7",
            "below = 1.2",
            r"parameter\[1\]: mount_stiffness: limit 1.2 must lie below",
        ),
        ('name = "mount_stiffness"', 'name = "mount"', r"map\.csv: no column \['mount'\]"),
    ],
)
def test_a_description_that_breaks_the_schema_is_refused(
    tmp_path: Path, old: str, new: str, needle: str
) -> None:
    """Each slip is refused with its key, and what was got or is needed."""
    text = stage_text()
    assert old in text
    with pytest.raises(BadStage, match=needle):
        load(tmp_path, text.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "slip"),
    [
        ("sigma = 0.3 }", "sigma = 0.3, medain = 2.0 }", "medain"),
        ('{ kind = "hertz-wear",', '{ kind = "hertz-wear", exponnt = 1.2,', "exponnt"),
    ],
    ids=["prior", "law"],
)
def test_unknown_keys_of_priors_and_laws_are_refused(
    tmp_path: Path, old: str, new: str, slip: str
) -> None:
    """A typing slip inside a prior or a law is seen, as everywhere in a description."""
    text = stage_text()
    assert old in text
    with pytest.raises(BadStage, match=slip):
        load(tmp_path, text.replace(old, new))


def test_covariate_names_are_unique(tmp_path: Path) -> None:
    """Two covariates of one name are refused with the name."""
    tail = '[[covariate]]\nname = "temperature_c"\nreference = 21.0\nprior_std = 0.001\n' * 2
    with pytest.raises(BadStage, match=r"\[\[covariate\]\] names must be unique.*temperature_c"):
        make_stage(tmp_path, tail=tail)


def test_one_thing_chooses_the_service_date(tmp_path: Path) -> None:
    """A risk and a ratio of costs together are refused by key; 5 % where neither is."""
    both = "[decision]\nmax_risk = 0.1\ncost_ratio = 20\n"
    with pytest.raises(BadStage, match=r"decision: cost_ratio = 20 and max_risk = 0\.1 each"):
        make_stage(tmp_path, tail=both)
    with pytest.raises(BadStage, match=r"decision\.cost_ratio: Expected `float` > 1"):
        make_stage(tmp_path, tail="[decision]\ncost_ratio = 1.0\n")
    for tail, risk, ratio in (
        ("", 0.05, None),
        ("[decision]\nmax_risk = 0.1\n", 0.1, None),
        ("[decision]\ncost_ratio = 20\n", None, 20.0),
    ):
        decision = make_stage(tmp_path, tail=tail).description.decision
        assert (decision.accepted, decision.cost_ratio) == (risk, ratio)


def test_a_baseline_outside_the_map_is_refused(tmp_path: Path) -> None:
    """The state at baseline has to be on the map."""
    with pytest.raises(
        BadStage,
        match=r"parameter\[1\]\.baseline: the baseline 9 of mount_stiffness lies out",
    ):
        make_stage(tmp_path, (PRELOAD + "\n", MOUNT.replace("limit =", "baseline = 9.0\nlimit =")))


def test_a_prior_beyond_the_map_is_refused(tmp_path: Path) -> None:
    """A prior outside the map is refused."""
    inside = 'kind = "lognormal", median = 1.0, sigma = 0.3'
    far = MOUNT.replace(inside, 'kind = "uniform", low = 5, high = 6')
    with pytest.raises(BadStage, match=r"parameter\[1\]\.prior: .*mount_stiffness has"):
        make_stage(tmp_path, (PRELOAD, far))


def test_modes_that_move_alone_have_a_probability_together(tmp_path: Path) -> None:
    """It is that of each mode times their number, with a common wander no more than 1."""
    head, *rows = map_rows(("guide_preload",), 3)
    text, low = stage_text((FADING,), n_modes=3, tail="[life]\nlone_mode = LONE\n"), "low_"
    more = [re.sub(r"(\w+),([\d.]+)$", lambda m: f"{low}{m[1]},{float(m[2]) / 2}", r) for r in rows]
    (tmp_path / "map.csv").write_text("\n".join([head, *rows, *more]) + "\n")
    for name, f in (("roll", 63.2), ("pitch", 68.3), ("yaw", 77.5)):
        text += f'[[mode]]\nname = "{low}{name}"\nfrequency_hz = {f}\ndamping_ratio = 0.02\n'
    path = tmp_path / "six.toml"
    path.write_text(text.replace("LONE", "0.14"))
    assert len(load_stage(str(path)).informative) == 6
    path.write_text(text.replace("LONE", "0.2"))
    with pytest.raises(BadStage, match=r"life.lone_mode: 6 modes with 0.2 each .*at most 0.15"):
        load_stage(str(path))


def test_a_map_without_any_tracked_mode_is_refused(tmp_path: Path) -> None:
    """A map without any mode of the description is refused with both lists."""
    text = stage_text().replace('name = "roll"', 'name = "bounce"').replace('"pitch"', '"sway"')
    with pytest.raises(BadStage, match=r"none of them is a tracked.*bounce"):
        load(tmp_path, text)


def test_a_search_has_one_definition() -> None:
    """The band that is searched and the offset from the description have the same ends."""
    mode = ModeSpec("roll", 120.0, 0.015, search=0.9)
    low, high = mode.searched
    assert (low, high) == pytest.approx((120.0 / 1.9, 228.0))
    offset = search_offset(np.array([low, 120.0, high]), mode.frequency_hz, mode.search)
    assert offset == pytest.approx([-1.0, 0.0, 1.0])


@pytest.mark.parametrize("slip", ["pich", "Pitch"])
def test_a_misspelt_mode_is_refused(tmp_path: Path, slip: str) -> None:
    """A name like that of a mode of the map in its search, which nothing else describes."""
    text = stage_text()
    assert 'name = "pitch"' in text
    with pytest.raises(
        BadStage, match=rf"mode\[1\]\.name: '{slip}' is not on the map, whose 'pitch'"
    ):
        load(tmp_path, text.replace('name = "pitch"', f'name = "{slip}"'))
    elsewhere = f'name = "{slip}"\nsearch = 0.001\nfrequency_hz = 300.0 #'
    found = text.replace('name = "pitch"\nfrequency_hz =', elsewhere)
    assert found != text and load(tmp_path, found).modes[1].name == slip


def test_a_file_that_is_not_there_and_a_name_nobody_knows(tmp_path: Path) -> None:
    """A missing path is named; for an unknown name the shipped ones are listed."""
    with pytest.raises(BadStage, match=r"gone\.toml"):
        load_stage(str(tmp_path / "gone.toml"))
    with pytest.raises(BadStage, match="lms-x, lms-y"):
        load_stage("lms-z")


def test_a_file_that_is_no_toml_is_refused(tmp_path: Path) -> None:
    """Broken syntax names the file and the line."""
    with pytest.raises(BadStage, match=r"odd\.toml: no TOML: "):
        load(tmp_path, 'name = "odd"\nmode = }\n')


def test_a_description_needs_a_mode(tmp_path: Path) -> None:
    """An empty list of modes leaves nothing to look for."""
    with pytest.raises(BadStage, match=r"mode: Expected `array` of length >= 1"):
        load(tmp_path, 'name = "odd"\nmode = []\n')


def test_drift_is_zero_at_baseline_and_follows_the_map(stage: Stage) -> None:
    """Predicted drifts are those of the formula behind the map, for the modes asked for."""
    x = np.log([[1.0, 1.0], [0.7, 0.8], [0.4, 1.2]])
    known = true_drift(("guide_preload", "mount_stiffness"), x)
    np.testing.assert_allclose(stage.drift(x, ("pitch", "roll")), known[:, [1, 0]], atol=1e-12)
    assert (stage.drift(x[:1], ("roll",)) == 0).all()


def test_a_stage_without_parameters_needs_no_map(tmp_path: Path) -> None:
    """Modes can be tracked without health; asking for health then is refused."""
    stage = make_stage(tmp_path, ())
    assert stage.modal_map is None
    assert stage.informative == ()
    with pytest.raises(BadStage, match=r"no \[map\]"):
        stage.drift(np.zeros((1, 1)), ("roll",))


def test_a_map_of_no_parameter_is_refused(tmp_path: Path) -> None:
    """Nothing would use it, nor notice that its file is missing."""
    with pytest.raises(BadStage, match=r"\[map\] needs a \[\[parameter\]\]"):
        load(tmp_path, stage_text(()) + '[map]\nfile = "gone.csv"\nmodel_std = 0.9\n')


def test_modes_that_are_not_tracked_do_not_inform(tmp_path: Path) -> None:
    """Health is inferred from tracked modes on the map."""
    text = stage_text(n_modes=3).replace(
        "damping_ratio = 0.015", "damping_ratio = 0.015\ntracked = false"
    )
    assert load(tmp_path, text).informative == ("roll",)


def test_the_digest_covers_description_and_map(tmp_path: Path, stage: Stage) -> None:
    """A change of the description or of the map alone changes the digest."""
    same = make_stage(tmp_path / "same")
    other = make_stage(tmp_path / "other", model_std=0.04)
    rows = map_rows(("guide_preload", "mount_stiffness"))
    (tmp_path / "same" / "map.csv").write_text("\n".join([rows[0], *rows[:0:-1]]) + "\n")
    moved = load_stage(str(tmp_path / "same" / "small.toml"))
    assert stage.digest == same.digest
    assert len({stage.digest, other.digest, moved.digest}) == 3


def test_logs_find_their_description(tmp_path: Path) -> None:
    """A description named in the manifest decides; without one the pattern of the stage does."""
    stage = make_stage(tmp_path, (FADING,), tail='[match]\nstage = "*-X"')
    moment = datetime(2026, 1, 1, tzinfo=UTC)
    assert stage.matches(Metadata(stage="AX-X", recorded_at=moment))
    assert not stage.matches(Metadata(stage="AX-Y"))
    assert not stage.matches(Metadata())
    assert stage.matches(Metadata(stage="AX-Y", description="small"))
    assert stage.matches(Metadata(stage="AX-Y", description="small.toml"))
    assert not stage.matches(Metadata(stage="AX-X", description="large"))


def test_a_verdict_names_a_parameter_by_its_name(tmp_path: Path) -> None:
    """Two names are shortened, and any word may be stated; no law means unchanging."""
    stage = make_stage(tmp_path, (PRELOAD, MOUNT, FOOT))
    assert [p.word for p in stage.parameters] == ["preload", "mount", "foot"]
    stage = make_stage(tmp_path, (PRELOAD, MOUNT, FOOT + 'verdict = "preload"\n'))
    assert stage.parameters[2].word == "preload"
    assert stage.parameters[2].laws == (Unchanging(),)


def test_keys_that_nothing_uses_are_accepted(tmp_path: Path) -> None:
    """Existing files with source, direction and loops load, whatever a loop holds."""
    text = stage_text().replace('name = "small"', 'name = "small"\nsource = "a note"')
    text = text.replace("damping_ratio = 0.015", 'damping_ratio = 0.015\ndirection = "roll"')
    loop = '[[loop]]\nid = "first"\nnumerator = [1.0]\ndenominator = [1.0, 2.0]\n'
    assert load(tmp_path, text + loop).modes == load(tmp_path, stage_text()).modes[:1] + tuple(
        structs.replace(mode, direction="roll") for mode in load(tmp_path, stage_text()).modes[1:]
    )


@pytest.mark.parametrize("word", ["healthy", "both", "a+b"])
def test_a_word_with_another_meaning_in_verdicts_is_refused(tmp_path: Path, word: str) -> None:
    """The message names the key."""
    with pytest.raises(BadStage, match=rf"parameter\[0\]: '{re.escape(word)}'"):
        make_stage(tmp_path, (PRELOAD + f'verdict = "{word}"\n',))


WEAR = PRELOAD[PRELOAD.index('{ kind = "hertz-wear"') :].rstrip()


def with_laws(*laws: str) -> str:
    """Write a preload of several laws."""
    start = PRELOAD[: PRELOAD.index("law = ")]
    return f"{start}law = [{', '.join(laws)}]\n"


def test_a_parameter_has_one_law_or_several(tmp_path: Path) -> None:
    """One law is a table, several are an array, in their order and with their weights."""
    linear = 'rate_per_km = { kind = "normal", mean = 0.0, std = 2e-4 }'
    parameter = with_laws(
        WEAR, f'{{ kind = "linear", weight = 2.5, {linear} }}', '{ kind = "none" }'
    )
    stage = make_stage(tmp_path, (parameter, MOUNT))
    preload, mount = (p.laws for p in stage.parameters)
    assert [law.kind for law in preload] == ["hertz-wear", "linear", "none"]
    assert [law.weight for law in preload] == [1.0, 2.5, 1.0]
    assert preload[0] == make_stage(tmp_path / "alone").parameters[0].law
    assert [law.kind for law in mount] == ["loosening"]


def test_laws_that_are_those_of_no_statement_stay_as_stated(tmp_path: Path) -> None:
    """A change without a law has the stated standard deviation; of workers' copies too."""
    stage = make_stage(tmp_path, (with_laws('{ kind = "none" }', '{ kind = "free" }'), MOUNT))
    for one in (stage, pickle.loads(pickle.dumps(stage))):
        assert one.parameters[0].laws == (Unchanging(), Free())


def test_a_wider_prior_allows_a_larger_change(tmp_path: Path) -> None:
    """Where no law is stated; a part of the prior below 0 makes no step."""

    def std(prior: str) -> float:
        text = re.sub("prior = .*", f"prior = {{ {prior} }}", PRELOAD[: PRELOAD.index("law = ")])
        stage = make_stage(tmp_path, (text, MOUNT))
        none, free = stage.parameters[0].laws
        assert none == Unchanging() and isinstance(free, Free)
        assert pickle.loads(pickle.dumps(stage)).parameters[0].laws == (none, free)
        return free.std

    found = [std(f'kind = "normal", mean = 1.0, std = {s}') for s in (0.3, 0.99, 1.01, 2.0, 10.0)]
    assert found == sorted(found)
    assert found[2] == pytest.approx(found[1], rel=0.02)
    assert std('kind = "lognormal", median = 1.0, sigma = 0.3') == pytest.approx(0.3, rel=1e-3)
    assert 0.5 < std('kind = "uniform", low = -1.0, high = 1.5') < 1


@pytest.mark.parametrize(
    ("laws", "needle"),
    [
        (
            ('{ kind = "none" }', WEAR, WEAR),
            r"parameter\[0\]: guide_preload: two laws of the kind 'hertz-wear'",
        ),
        ((), r"parameter\[0\]\.law: .*length >= 1"),
        (
            (WEAR, '{ kind = "rust" }'),
            r"parameter\[0\]\.law\[1\]\.kind: there are hertz-w",
        ),
        (
            ('{ kind = "none", weight = 0 }',),
            r"parameter\[0\]\.law\[0\]\.weight: needed a number from 1e-06 to 1e",
        ),
        (('{ kind = "none", wieght = 2 }',), r"parameter\[0\]\.law\[0\]\.wieght"),
    ],
    ids=["twice", "empty", "unknown", "weightless", "slip"],
)
def test_laws_that_are_none_are_refused_with_their_place(
    tmp_path: Path, laws: tuple[str, ...], needle: str
) -> None:
    """Of several laws the one that is wrong is named by its place."""
    with pytest.raises(BadStage, match=needle):
        load(tmp_path, stage_text((with_laws(*laws), MOUNT)))


@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_shipped_stages_load(name: str) -> None:
    """Shipped descriptions load, with three modes that inform two limited parameters."""
    stage = load_stage(name)
    assert name in shipped()
    assert len(stage.informative) == 3
    assert [p.name for p in stage.parameters] == ["guide_preload", "mount_stiffness"]
    assert all(p.limit for p in stage.parameters)


@pytest.mark.parametrize(("name", "band"), [("lms-x", (10, 150)), ("lms-y", (10, 390))])
def test_shipped_stages_have_the_papers_health_band(name: str, band: tuple[float, float]) -> None:
    """The health band comes from the description."""
    assert load_stage(name).description.health_band_hz == band


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("health_band_hz = [150, 10]", "health_band_hz reaches from 150 to 10 Hz"),
        ("health_band_hz = [10]", "health_band_hz: .*length 2"),
        ("[[watch]]\nlow_hz = 20\nhigh_hz = 20", r"watch\[0\]: .*needed low < high"),
    ],
)
def test_a_band_that_is_none_is_named(tmp_path: Path, line: str, key: str) -> None:
    """Bands whose ends are swapped or missing are errors at the door."""
    path = tmp_path / "bad.toml"
    path.write_text(
        f'name = "bad"\n{line}\n[[mode]]\nname = "roll"\nfrequency_hz = 5\ndamping_ratio = 0.1\n'
    )
    with pytest.raises(BadStage, match=key):
        load_stage(str(path))


def everything() -> dict[str, Any]:
    """Return a valid description with every numeric key, for lists of all of them."""
    text = stage_text().replace(
        "[map]",
        """[[watch]]
low_hz = 20
high_hz = 30
[[order]]
name = "ball pass"
wavelength_mm = 4.0
[[channel]]
name = "acc_roll"
position_m = [0.1, 0.2, 0.3]
direction = [0, 0, 1]
[map]""",
    )
    made = tomllib.loads(text)
    made |= {"health_band_hz": [10.0, 390.0], "baseline": {"logs": 5}}
    made |= {"decision": {"max_risk": 0.05}, "usage": {"km_per_day": 12.0, "horizon_km": 2e4}}
    made["mode"][0] |= {"snr": 100.0, "search": 0.15, "shape": {"acc_roll": 1.0}}
    made["covariate"][0]["curvature_std"] = 0.002
    life = {"kind": "normal", "mean": 8000.0, "std": 2000.0}
    exponent = {"kind": "uniform", "low": 2.0, "high": 12.0}
    slow = {"kind": "lognormal", "median": 0.1, "sigma": 1.0}
    laws = [
        {"kind": "accelerating", "life_km": life, "exponent": exponent, "slow": slow},
        {"kind": "linear", "rate_per_km": {"kind": "normal", "mean": 1e-4, "std": 3e-5}},
        {"kind": "none", "weight": 1.0},
    ]
    made["parameter"][0] |= {"baseline": 1.0, "law": laws}
    made["parameter"][1]["prior"] = {"kind": "uniform", "low": 0.5, "high": 1.2}
    return made


def numbers(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the place of every number of a description."""
    if isinstance(value, dict | list):
        for key, one in value.items() if isinstance(value, dict) else enumerate(value):
            yield from numbers(one, (*path, key))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path


def literal(value: Any) -> str:
    """Write a value of TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {literal(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(literal, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


def with_number(folder: Path, places: Iterable[tuple[Any, ...]], value: float) -> Path:
    """Write the description of everything with a number at some places."""
    made = everything()
    for *path, key in places:
        reduce(lambda table, own: table[own], path, made)[key] = value
    file = folder / "everything.toml"
    file.write_text("\n".join(f"{key} = {literal(one)}" for key, one in made.items()))
    return file


PLACES = [*numbers(everything())]


@pytest.mark.parametrize("place", PLACES, ids=lambda place: ".".join(map(str, place)))
def test_every_number_has_a_range_in_its_type(tmp_path: Path, place: Any) -> None:
    """Huge, infinite and undefined numbers are refused by the key, wherever a number is."""
    write_map(tmp_path)
    assert load_stage(str(with_number(tmp_path, (), 0.0))).modes
    for value in (1e300, -1e300, np.inf, np.nan, 10**30):
        with pytest.raises(BadStage) as caught:
            load_stage(str(with_number(tmp_path, [place], value)))
        key = [key for key in place if isinstance(key, str)][-1]
        assert key in str(caught.value) and "needed" in str(caught.value)


extremes = st.sampled_from(
    [0, 1, -1, 5e-324, 1e-300, 1e-12, 1e-9, 1e-7, 1e-6, 1e-4, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99, 1.0,
     2, 10.0, 20.0, 1e3, 1e6, 1e7, 1e9, 1e12, 1e300, 2**63, 10**30]
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=400, deadline=None, derandomize=True, suppress_health_check=[*HealthCheck])
@given(places=st.lists(st.sampled_from(PLACES), min_size=1, max_size=2), value=extremes)
def test_extreme_numbers_are_refused_or_can_be_computed_with(
    places: list[tuple[Any, ...]], value: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A description that is accepted can be checked and planned with; any other is a `BadStage`."""
    folder = tmp_path_factory.mktemp("extreme")
    write_map(folder)
    try:
        stage = load_stage(str(with_number(folder, places, value)))
    except BadStage:
        return
    rows = stage_rows(checked := check_stage(stage), diagnose(checked))
    assert rows["modes"]
    with suppress(BadQuestion, OutsideMap):
        assert plan(stage, stage.parameters[0].name, 0.05).efforts


@pytest.mark.parametrize(
    ("rows", "needle"),
    [
        ("1e300", "line 2: frequency_hz is 1e.300; needed is a positive number, 0.001 to 1e.07"),
        ("1e-300", "line 2: frequency_hz is 1e-300; needed"),
        ("nan", "line 2: frequency_hz is nan; needed"),
        ("0", "line 2: frequency_hz is 0.0; needed"),
        ("-5", "line 2: frequency_hz is -5"),
        ("inf", "line 2: frequency_hz is inf"),
    ],
)
def test_numbers_of_a_map_have_ranges(tmp_path: Path, rows: str, needle: str) -> None:
    """A frequency, or a value of a parameter, that cannot be is named with its line."""
    for changed in ("f", "p"):
        lines = [f"{p},roll,{100 + p}" for p in (0.5, 1.0, 2.0)]
        lines[0] = f"0.5,roll,{rows}" if changed == "f" else f"{rows},roll,100"
        (tmp_path / "map.csv").write_text("\n".join(["guide_preload,mode,frequency_hz", *lines]))
        told = needle if changed == "f" else "line 2: guide_preload is"
        with pytest.raises(BadStage, match=told):
            read_map(str(tmp_path / "map.csv"), ("guide_preload",))


def test_grid_values_that_rounding_makes_equal_are_refused(tmp_path: Path) -> None:
    """Three values of a parameter that differ by less than rounding are no grid."""
    lines = [f"{1 + k * 1e-9!r},roll,{100 + k}" for k in range(3)]
    (tmp_path / "map.csv").write_text("\n".join(["p,mode,frequency_hz", *lines]))
    with pytest.raises(BadStage, match="grid values of p are equal but for rounding"):
        read_map(str(tmp_path / "map.csv"), ("p",))


@pytest.mark.parametrize("day", ["1969-12-31", "2100-01-01", "9999-12-31"])
def test_the_next_service_is_in_the_calendar(tmp_path: Path, day: str) -> None:
    """A date of service has the range of all dates."""
    with pytest.raises(BadStage, match=rf"decision: next_service is {day}, needed a day from 1970"):
        load(tmp_path, f"{stage_text()}\n[decision]\nnext_service = {day}\n")
