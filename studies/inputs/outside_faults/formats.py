"""Files of others: padding, starts of channels, times, units, and files that hold no log."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from lmshealth._private.arrays import FloatArray
from studies.inputs.outside_faults.case import Case, Program, Seen, last_line
from studies.inputs.outside_faults.no_logs import NO_LOGS

RATE, SECONDS_OF_LOG = 2000.0, 6.0
ANY = (0.0, 9.0)  # damping in %
# Natural frequency in Hz and damping ratio of the two modes of the inputs made here.
TRUE = ((126.0, 0.015), (155.0, 0.015))
Ask = Callable[[Program, Path], Seen]


def given(name: str) -> Path:
    """Return a file of the inputs from outside."""
    return Path(os.environ["LMSHEALTH_DATA"]) / "outside_faults" / name


def record(seed: int = 0, rate: float = RATE, seconds: float = SECONDS_OF_LOG) -> FloatArray:
    """Simulate two channels of two resonances in noise, ``(n_samples, 2)``."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    n = int(rate * seconds)
    modes = []
    for frequency, damping in TRUE:
        w = 2 * np.pi * frequency / rate
        poles = 2 * np.exp(-damping * w) * np.cos(w * (1 - damping**2) ** 0.5)
        driven = lfilter([1.0], [1.0, -poles, np.exp(-2 * damping * w)], rng.normal(size=n))
        modes.append(driven / driven.std())
    shapes = np.array([[1.0, 0.3], [-0.5, 1.0]])
    noisy = np.stack(modes, axis=1) @ shapes + 0.05 * rng.normal(size=(n, 2))
    return np.round(noisy, 5)


def table(path: Path, names: str, *columns: object, end: str = "", sep: str = ",") -> Path:
    """Write columns of numbers or text, with a line of names where there is one."""
    rows = (sep.join(map(str, row)) for row in zip(*columns, strict=True))
    path.write_text("\n".join([*([names] if names else []), *rows, end]), encoding="utf-8")
    return path


def found_modes(program: Program, path: Path, *options: str | Path) -> tuple[list[str], str]:
    """Return frequency and damping of the modes of a log, and why it is refused."""
    done = program("modes", path, *options, "--format", "json")
    answer = json.loads(done.stdout) if done.stdout.strip() else {}
    rows = answer.get("modes", [])
    text = [f"{m['frequency_hz']:.2f} Hz {100 * m['damping_ratio']:.2f} %" for m in rows]
    refused = [f"{r['channel']} {r['reason']}: {r['detail']}" for r in answer.get("refused", [])]
    return text, "; ".join(refused) or (last_line(done.stderr) if done.returncode else "")


def near(text: list[str], frequency: float, damping: tuple[float, float]) -> bool:
    """Return whether a mode is within 1 % of a frequency and in a range of damping (%)."""
    pairs = [tuple(map(float, one.replace("%", "").split(" Hz "))) for one in text]
    return any(abs(f / frequency - 1) < 0.01 and damping[0] <= z <= damping[1] for f, z in pairs)


def read(
    make: Callable[[Path], Path], frequency: float, program: Program, folder: Path, **more: object
) -> Seen:
    """Read a log without a map: the mode is there, and nothing is refused but as stated."""
    modes, refused = found_modes(program, make(folder))
    right = near(modes, frequency, more.get("damping", ANY))  # type: ignore[arg-type]
    allowed = str(more.get("allowed", ""))
    return Seen(
        right and (not refused or (bool(allowed) and allowed in refused)),
        f"{', '.join(modes)} {refused}".strip(),
    )


def refused(make: Callable[[Path], Path], words: tuple[str, ...], program: Program,
            folder: Path) -> Seen:  # fmt: skip
    """Read a file that must be refused with words in its reason, and without a useless advice."""
    _, why = found_modes(program, make(folder))
    return Seen(all(word in why for word in words) and "--columns" not in why, why[:160])


def proposed(make: Callable[[Path], Path], words: tuple[str, ...], program: Program,
             folder: Path, options: tuple[str, ...] = (), mode: float = 0.0) -> Seen:  # fmt: skip
    """Propose a map, which has words in it; for a mode, read the log by it.

    `init` writes only a map by which it has read the log.
    """
    path = make(folder)
    done = program("init", path, "--out", folder / "out", *options)
    where = folder / "out" / "map.toml"
    if not where.exists():
        return Seen(False, last_line(done.stderr))
    text = where.read_text("utf-8")
    modes, why = found_modes(program, path, "--columns", where) if mode else ([], "")
    lines = [line for line in text.splitlines() if " = " in line and "assumed: set" not in line]
    right = all(word in text for word in words) and not why and (not mode or near(modes, mode, ANY))
    return Seen(right, f"{'; '.join(modes)} {why} {' | '.join(lines)}".strip()[:200])


def asked(make: Callable[[Path], Path], words: tuple[str, ...], program: Program,
          folder: Path) -> Seen:  # fmt: skip
    """Propose a map where nothing states a unit: both readings are asked for."""
    done = program("init", make(folder), "--out", folder / "out")
    right = done.returncode == 1 and all(word in done.stderr for word in words)
    return Seen(right, last_line(done.stderr))


def uff(folder: Path, *, binary: bool, padding: bytes = b"", cut: int = 0) -> Path:
    """Write a time record in m/s² as a universal file, with bytes behind the stated samples."""
    values = record()[:, 0]
    if binary:
        body = values.astype("<f4").tobytes()
    else:
        rows = [values[k : k + 6] for k in range(0, values.size, 6)]
        body = "\n".join("".join(f"{v:13.5e}" for v in row) for row in rows).encode()
    body = body[: len(body) - cut] + padding
    axis = "    0    0    0 NONE                 "
    form = f"b     1     2          11{4 * values.size:>12}" if binary else ""
    head = [
        "    -1", "    58" + form, "own record", "NONE", "NONE", "NONE", "NONE",
        "    1         0    0         0 NONE               1   1 NONE               0   0",
        f"{2:10}{values.size:10}{1:10}  0.00000e+00{1 / RATE:13.5e}  0.00000e+00",
        f"        17{axis}s", f"        12{axis}m/s^2", f"         0{axis}NONE",
        f"         0{axis}NONE",
    ]  # fmt: skip
    path = folder / "record.uff"
    text = "".join(f"{line}\n" for line in head).encode()
    path.write_bytes(text + body + b"\n    -1\n")
    return path


def tdms(folder: Path, *, late: float = 0.0, moments: bool = False) -> Path:
    """Write three channels of one clock, of which the last starts some seconds later, rounded."""
    from nptdms import ChannelObject, TdmsWriter

    values, n_late = record(), round(late * RATE)
    begin = np.datetime64("2026-01-05T08:00:00", "us")
    path = folder / "channels.tdms"
    own: dict[str, object] = {"unit_string": "m/s^2"}
    channels = []
    for k, name in enumerate(("acc x", "acc y", "acc z")):
        start = late if k == 2 else 0.0
        clock = {"wf_increment": 1 / RATE, "wf_start_time": begin + round(1e6 * start)}
        samples = values[n_late if k == 2 else 0 :, k % 2] + 0.02 * np.random.default_rng(k).normal(
            size=len(values) - (n_late if k == 2 else 0)
        )
        channels.append(ChannelObject("g", name, samples, own | ({} if moments else clock)))
    if moments:
        stamps = begin + (np.arange(len(values)) * round(1e6 / RATE)).astype("m8[us]")
        channels.append(ChannelObject("g", "Zeit", stamps))
    with TdmsWriter(str(path)) as writer:
        writer.write_segment(channels)
    return path


def log(folder: Path) -> Path:
    """Write a log as the contract has it: the control of files that hold none."""
    times = (np.arange(len(record())) / RATE).tolist()
    return table(folder / "log.csv", "time_s,acc_x_g,acc_y_g", times, *record().T.tolist())


def timed(folder: Path, names: str, unit: float, digits: int, sep: str = ",") -> Path:
    """Write two channels with times in a unit of so many a second."""
    times = [f"{unit * k / RATE:.{digits}f}" for k in range(len(record()))]
    return table(folder / "timed.csv", names, times, *record().T.tolist(), sep=sep)


def many(folder: Path, n: int, rate: float = RATE) -> Path:
    """Write channels of equal standing."""
    values = [record(k, rate, 3.0)[:, 0].tolist() for k in range(n)]
    times = (np.arange(len(values[0])) / rate).tolist()
    return table(folder / "many.csv", ",".join(["Time", *(f"ch{k}" for k in range(n))]),
                 times, *values)  # fmt: skip


def written(name: str, content: bytes, folder: Path) -> Path:
    """Write a file of bytes."""
    (folder / name).write_bytes(content)
    return folder / name


def spectrum(folder: Path, names: str = "Frequency [Hz],PSD [g²/Hz]") -> Path:
    """Write a one-sided power spectral density."""
    f = np.arange(2000) / 2
    return table(folder / "psd.csv", names, f.tolist(), (1e-6 / ((f - 126) ** 2 + 4)).tolist())


EXACT: dict[bool, Ask] = {b: partial(read, partial(uff, binary=b), 126.0) for b in (False, True)}
CONTROL: Ask = partial(read, log, 126.0)
NAMED: Ask = partial(proposed, partial(timed, names="Time [us],a,b", unit=1e6, digits=0),
                     ("2000 Hz",), mode=126.0)  # fmt: skip


def _case(name: str, right: str, fault: Ask, control: Ask) -> Case:
    return Case("formats", name, right, fault, control)


def _outside(name: str) -> Callable[[Path], Path]:
    return lambda folder: given(name)


CASES: tuple[Case, ...] = (
    *(
        _case(
            name, "125.903 ± 0.231 Hz", partial(read, _outside(name), 125.903), EXACT["_b_" in name]
        )
        for name in (
            "uff_last_row_padded.uff",
            "uff_b_trailing_zeros.uff",
            "uff_b_nbytes_padded.uff",
        )
    ),
    _case(
        "UFF58, blank rows behind the last",
        "126 Hz",
        partial(read, partial(uff, binary=False, padding=b"\n" + b" " * 78), 126.0),
        EXACT[False],
    ),
    _case(
        "UFF58, 1000 bytes of zeros behind the last sample",
        "126 Hz",
        partial(read, partial(uff, binary=True, padding=bytes(1000)), 126.0),
        EXACT[True],
    ),
    _case(
        "UFF58, the last 400 bytes are cut off",
        "corrupt",
        partial(refused, partial(uff, binary=True, cut=400), ("corrupt",)),
        EXACT[True],
    ),
    *(
        _case(
            name,
            "aligned: damping 1.65 ± 0.17 % of the mode at 126 Hz",
            partial(
                read, _outside(name), 126.0, damping=(1.31, 1.99), allowed="starts 1000 samples"
            ),
            partial(read, tdms, 126.0),
        )
        for name in ("tdms_starts_differ_3.tdms", "tdms_starts_differ_same_length.tdms")
    ),
    _case(
        "TDMS, a channel starts 0.25 s later",
        "aligned, with a note",
        partial(read, partial(tdms, late=0.25), 126.0, allowed="starts 500 samples"),
        partial(read, tdms, 126.0),
    ),
    _case(
        "TDMS, a channel starts 500.4 samples later",
        "the late channel refused with both starts",
        partial(read, partial(tdms, late=0.2502), 126.0, allowed="starts at 0.2502 s, the others"),
        partial(read, tdms, 126.0),
    ),
    _case(
        "tdms_time_channel.tdms",
        "2000 Hz",
        partial(proposed, _outside("tdms_time_channel.tdms"), ("2000 Hz",), mode=126.0),
        partial(proposed, tdms, ("acc_x",), mode=126.0),
    ),
    _case(
        "TDMS, times in a channel Zeit",
        "read without a map: 126 Hz",
        partial(read, partial(tdms, moments=True), 126.0),
        partial(read, tdms, 126.0),
    ),
    _case(
        "rrf_m956.csv",
        "X 51.6, Y 78.2 Hz proposed",
        partial(
            proposed,
            _outside("rrf_m956.csv"),
            ("acc_x", "acc_y"),
            mode=51.6,
            options=("--sample-rate", "1344"),
        ),
        NAMED,
    ),
    *(
        _case(name, "400 Hz", partial(proposed, _outside(name), (" 400 Hz",)), NAMED)
        for name in ("time_lowercase.csv", "millis.csv", "axivity.csv")
    ),
    _case(
        "12 channels of equal standing",
        "all 12 proposed",
        partial(proposed, partial(many, n=12), tuple(f'"acc_ch{k}"' for k in range(12))),
        NAMED,
    ),
    _case(
        "rounded_1us.csv",
        "both readings: 25.6 Hz and 25600 Hz",
        partial(asked, _outside("rounded_1us.csv"), ("25.6 Hz", "25600 Hz", "--sample-rate")),
        NAMED,
    ),
    _case(
        "rounded_1us.csv with its rate",
        "4306, 7100 Hz",
        partial(
            proposed,
            _outside("rounded_1us.csv"),
            ("time_us",),
            mode=4306.0,
            options=("--sample-rate", "25600"),
        ),
        NAMED,
    ),
    _case(
        "nameless times in ms",
        "both readings: 2 Hz and 2000 Hz",
        partial(
            asked, partial(timed, names="", unit=1e3, digits=1), ("2 Hz in s", "2000 Hz in ms")
        ),
        NAMED,
    ),
    _case(
        "a column Time in µs",
        "both readings: 2 Hz and 2000 Hz",
        partial(
            asked,
            partial(timed, names="Time,a,b", unit=1e6, digits=0),
            ("2 Hz in ms", "2000 Hz in us"),
        ),
        NAMED,
    ),
    *(
        _case(
            f"no log, {name}",
            f"is {what}",
            partial(refused, partial(written, name, content), (what,)),
            CONTROL,
        )
        for name, (content, what) in NO_LOGS.items()
    ),
    _case(
        "a table of a spectrum",
        "is a table over frequency",
        partial(refused, spectrum, ("a table over frequency",)),
        CONTROL,
    ),
    _case(
        "a spectrum called acc_x_g",
        "is a table over frequency",
        partial(
            refused, partial(spectrum, names="frequency_hz,acc_x_g"), ("a table over frequency",)
        ),
        CONTROL,
    ),
)
