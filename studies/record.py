"""How a study keeps what it found: numbers with seed, versions, machine and run time."""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from studies.metrics import Coverage, clopper_pearson
from studies.resume import KEPT, Trials

# How often intervals claim to hold the truth, and how sure the judgement of that is.
NOMINAL, LEVEL = 0.95, 0.999
_PACKAGES = ("lmshealth", "numpy", "scipy", "emcee", "filterpy")


def options(doc: str | None) -> argparse.ArgumentParser:
    """Make the parser of a study's options, which all studies have."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a small part, and record nothing")
    return parser


class Study:
    """A study that is carried out: its options, its trials, its clock, its record.

    Parameters
    ----------
    script : str
        ``__file__`` of its script: the record of ``run.py`` is ``result.json``, that of any other
        script has its name.
    doc : str
        Docstring of the script; its first line is the question.
    chosen : Namespace, optional
        Options, where there are more than ``--quick``.

    Attributes
    ----------
    quick : bool
        Whether a small part is done, and nothing recorded.
    trials : Trials
        What is done once; of the quick form nothing is kept.
    """

    def __init__(
        self, script: str, doc: str | None, chosen: argparse.Namespace | None = None
    ) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        self.options = chosen or options(doc).parse_args()
        self.quick: bool = self.options.quick
        self._folder, self._stem = Path(script).parent, Path(script).stem
        self._question = str(doc).split("\n", 1)[0]
        self.trials = Trials(self.kept(self._folder.name))

    def kept(self, name: str) -> Path | None:
        """Name the file in which trials are kept; the quick form has none."""
        return None if self.quick else KEPT / f"{name}.jsonl"

    def conclude(
        self,
        answer: Mapping[str, Any],
        *,
        beside: Mapping[str, Any] | None = None,
        name: str = "",
        not_met: Iterable[str] = (),
        quick_may_fail: bool = False,
    ) -> None:
        """Print what was found, record it unless it is the quick form, and fail where it fails.

        Parameters
        ----------
        answer : mapping
            With ``passed``, whether each thing asked is so.
        beside : mapping, optional
            What is recorded beside it and not printed.
        name : str, optional
            Of the record, where it is not that of the script.
        not_met : iterable of str
            What is known not to be so.
        quick_may_fail : bool
            Whether the quick form is too small to be judged.
        """
        print(json.dumps(answer, indent=1))
        if not self.quick:
            name = name or {"run": "result"}.get(self._stem, self._stem)
            self._keep(self._folder / f"{name}.json", {**answer, **(beside or {})})
        failed = [what for what, fine in answer.get("passed", {}).items() if not fine]
        if not set(failed) <= set(not_met) and not (self.quick and quick_may_fail):
            raise SystemExit(f"not as asked: {failed}")

    def _keep(self, path: Path, answer: Mapping[str, Any]) -> None:
        """Write a record: seed and numbers, versions, and run time with that of kept trials."""
        content = {
            "question": self._question,
            **answer,
            "recorded": {
                "date": datetime.now(UTC).date().isoformat(),
                "python": platform.python_version(),
                **{name: version(name) for name in _PACKAGES},
                "wall_s": round(time.perf_counter() - self._wall, 1),
                "cpu_s": round(time.process_time() - self._cpu, 1),
                "kept_s": round(self.trials.kept_s, 1),
            },
        }
        path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def judge_coverage(hits: int, n: int, nominal: float = NOMINAL) -> dict[str, Any]:
    """Tell how often intervals hold the truth, and whether that may be as often as they claim."""
    return as_row(Coverage(nominal, hits, n, *clopper_pearson(hits, n, LEVEL)))


def as_row(found: Coverage) -> dict[str, Any]:
    """Write a coverage down."""
    return {"hits": found.hits, "n": found.n, "share": found.share, "low": found.low,
            "high": found.high, "holds": found.holds}  # fmt: skip
