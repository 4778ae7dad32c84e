"""What has been done already: identified logs by their content, so that a run can go on.

A row is one log, identified with one stage description by one version of the package; any change
of the three is another key, so that stale results are done again and nothing else is.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import String, Text, create_engine, select
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column

from lmshealth.arrays import FloatArray
from lmshealth.errors import LmshealthError
from lmshealth.history import Reading
from lmshealth.logs import Metadata, Refusal
from lmshealth.results import Line, Modes
from lmshealth.waterfall import Levels

SCHEMA = 3  # part of the name of the table: what an older one holds is not read


class StoreError(LmshealthError):
    """A store that cannot be opened, read or written."""


class _Base(DeclarativeBase):
    pass


class _Identified(_Base):
    __tablename__ = f"identified_{SCHEMA}"

    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    log: Mapped[str] = mapped_column(Text)
    outcome: Mapped[str] = mapped_column(Text)


def beside(folder: Path) -> URL:
    """URL of the default store: a SQLite file in the folder of the output, whatever its name."""
    return URL.create("sqlite", database=str(folder / "lmshealth.sqlite"))


def result_key(digest: str, *circumstances: str) -> str:
    """Name a result by the content of its log and everything else it depends on."""
    return hashlib.sha256("\n".join([digest, *circumstances]).encode()).hexdigest()


class Store:
    """Results of single logs behind an SQLAlchemy URL.

    Parameters
    ----------
    url : str or URL
        Such as ``sqlite:///results.sqlite``.

    Raises
    ------
    StoreError
        If it cannot be opened.
    """

    def __init__(self, url: str | URL) -> None:
        try:
            self._shown = make_url(url).render_as_string(hide_password=True)
            self._engine = create_engine(url)
            _Base.metadata.create_all(self._engine)
        except (ArgumentError, SQLAlchemyError, ImportError, ValueError) as error:
            # The URL may hold a password, before the host or among its options.
            shown = re.sub(r"//[^/]*@", "//", str(url)).split("?")[0]
            detail = str(error).replace(str(url), shown)
            raise StoreError(f"cannot open the store {shown}: {detail}") from error

    def close(self) -> None:
        """Let go of all connections."""
        self._engine.dispose()

    def get(self, key: str, log: str) -> Reading | tuple[Refusal, ...] | None:
        """Fetch the outcome of a log under its present name; None when it is not there."""
        with self._session() as session:
            row = session.scalar(select(_Identified).where(_Identified.key == key))
            return None if row is None else _from_json(row.outcome, log)

    def put(self, key: str, log: str, outcome: Reading | tuple[Refusal, ...]) -> None:
        """Keep the outcome of a log; the same key again changes nothing."""
        with self._session() as session:
            session.merge(_Identified(key=key, log=log, outcome=_to_json(outcome)))

    @contextmanager
    def _session(self) -> Iterator[Session]:
        try:
            with Session(self._engine) as session, session.begin():
                yield session
        except SQLAlchemyError as error:
            raise StoreError(f"the store {self._shown} failed: {error}") from error


def _to_json(outcome: Reading | tuple[Refusal, ...]) -> str:
    if not isinstance(outcome, Reading):
        return json.dumps({"refused": [_refusal(refusal) for refusal in outcome]})
    metadata, modes, levels = outcome.metadata, outcome.modes, outcome.levels
    return json.dumps(
        {
            "digest": outcome.digest,
            "metadata": {
                "stage": metadata.stage,
                "recorded_at": metadata.recorded_at and metadata.recorded_at.isoformat(),
                "travel": metadata.travel,
                "covariates": metadata.covariates,
                "servo_id": metadata.servo_id,
                "baseline": metadata.baseline,
                "description": metadata.description,
            },
            "loop_error": outcome.loop_error,
            "levels": levels and [levels.low, levels.high, _without_nan(levels.level)],
            "modes": {
                "names": modes.names,
                "sources": modes.sources,
                "channels": modes.channels,
                "ln_frequency": modes.ln_frequency.tolist(),
                "ln_damping": modes.ln_damping.tolist(),
                "cov": modes.cov.tolist(),
                "snr": modes.snr.tolist(),
                "dispersion": _without_nan(modes.dispersion),
                "flags": modes.flags,
                "shape_channels": modes.shape_channels,
                "shapes": _without_nan(modes.shapes),
                "lines": [
                    [line.frequency, line.amplitude, line.unit, line.kind, line.channel]
                    for line in modes.lines
                ],
                "refused": [_refusal(refusal) for refusal in modes.refused],
            },
        }
    )


def _without_nan(values: FloatArray) -> Any:
    """Put None, which JSON knows, in the place of what is missing."""
    known = values.astype(object)
    known[np.isnan(values)] = None
    return known.tolist()


def _refusal(refusal: Refusal) -> dict[str, str]:
    return {name: getattr(refusal, name) for name in Refusal.__slots__ if name != "log"}


def _from_json(text: str, log: str) -> Reading | tuple[Refusal, ...]:
    content = json.loads(text)
    if "modes" not in content:
        return tuple(Refusal(log=log, **row) for row in content["refused"])
    metadata = content["metadata"]
    moment, levels = metadata.pop("recorded_at"), content["levels"]
    return Reading(
        log=log,
        digest=content["digest"],
        metadata=Metadata(recorded_at=moment and datetime.fromisoformat(moment), **metadata),
        modes=_modes(content["modes"], log),
        loop_error=content["loop_error"],
        levels=levels and Levels(levels[0], levels[1], np.array(levels[2], dtype=float)),
    )


def _modes(content: dict[str, Any], log: str) -> Modes:
    n = len(content["names"])
    return Modes(
        names=tuple(content["names"]),
        sources=tuple(content["sources"]),
        channels=tuple(content["channels"]),
        ln_frequency=np.array(content["ln_frequency"], dtype=float),
        ln_damping=np.array(content["ln_damping"], dtype=float),
        cov=np.array(content["cov"], dtype=float).reshape(2 * n, 2 * n),
        snr=np.array(content["snr"], dtype=float),
        dispersion=np.array(content["dispersion"], dtype=float),
        flags=tuple(content["flags"]),
        shape_channels=tuple(content["shape_channels"]),
        shapes=np.array(content["shapes"], dtype=float).reshape(n, len(content["shape_channels"])),
        lines=tuple(Line(*row) for row in content["lines"]),
        refused=tuple(Refusal(log=log, **row) for row in content["refused"]),
    )
