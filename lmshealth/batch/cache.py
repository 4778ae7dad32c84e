"""Pure functions whose values a store keeps; the runs on a store divide the work among them."""

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from lmshealth.batch import constants
from lmshealth.batch.store import Store
from lmshealth.batch.workers import OnCrash, Pool, Progress, Task

Piece = TypeVar("Piece")
Job = TypeVar("Job")
Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Resources:
    """Store, workers and progress callback of a batch."""

    store: Store
    pool: Pool
    progress: Progress = lambda step, done, total: None


@dataclass(frozen=True, slots=True)
class Cached(Generic[Piece, Job, Value]):
    """A pure function of pieces of work, whose values a store keeps.

    A run claims pieces, ``size`` at a time, and makes a ``job`` of those that it gets, of which a
    worker computes the function; ``on_crash`` makes the value of a job that ends its worker.
    ``key`` is the fingerprint of all that the value of a piece depends on, and ``fetch`` takes
    values of pieces from the store, and yields those pieces whose value was there.
    """

    function: Task[Job, Value]
    on_crash: OnCrash[Job, Value]
    key: Callable[[Piece], str] = field(kw_only=True)
    fetch: Callable[[Sequence[Piece]], Iterable[Piece]] = field(kw_only=True)
    job: Callable[[Sequence[Piece]], Job] = field(kw_only=True)
    size: int = field(default=1, kw_only=True)

    def values(self, pieces: Sequence[Piece], resources: Resources) -> Iterator[tuple[Job, Value]]:
        """Compute the values of all pieces that no other run does; yield each job with its value.

        What other runs have claimed is looked at again in the end: they store its value, or end
        without. The caller stores a value before it asks for the next.
        """
        left = pieces
        while left:
            others = yield from self._unclaimed(left, resources)
            if len(others) == len(left):
                time.sleep(constants.OTHERS_POLL_S)
            left = others

    def _unclaimed(
        self, pieces: Sequence[Piece], resources: Resources
    ) -> Generator[tuple[Job, Value], None, list[Piece]]:
        """Compute the values of unclaimed pieces; return the pieces that others have claimed."""
        store, others, claimed = resources.store, list[Piece](), dict[int, list[str]]()

        def jobs() -> Iterator[Job]:
            for first in range(0, len(pieces), self.size):
                part = [(self.key(piece), piece) for piece in pieces[first : first + self.size]]
                own = store.claim([key for key, _ in part])
                others.extend(piece for key, piece in part if key not in own)
                mine = [piece for key, piece in part if key in own]
                if store.is_divided:  # another run may have done it since this one began
                    done = {self.key(piece) for piece in self.fetch(mine)}
                    store.release(list(done))
                    mine = [piece for piece in mine if self.key(piece) not in done]
                if mine:
                    job = self.job(mine)
                    claimed[id(job)] = [self.key(piece) for piece in mine]
                    yield job

        for job, value in resources.pool.map_unordered(self.function, jobs(), self.on_crash):
            yield job, value
            store.release(claimed.pop(id(job)))
        return others
