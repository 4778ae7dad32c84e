"""Errors of lmshealth: each names what was found, what is needed and what to do next."""


class LmshealthError(Exception):
    """Base of every error that lmshealth raises on purpose.

    Examples
    --------
    >>> import lmshealth
    >>> try:
    ...     lmshealth.read_log("nothing.h5")
    ... except lmshealth.LmshealthError as error:
    ...     print(error)
    nothing.h5: missing-file: cannot be opened: No such file or directory
    """


class BadLog(LmshealthError):
    """A log that cannot be used.

    The reason is the code in the ``reason`` column of ``refused.csv``; the detail states what was
    found, what is needed, and the next step.
    """

    def __init__(self, log: str, reason: str, detail: str) -> None:
        super().__init__(f"{log}: {reason}: {detail}")
        self.log = log
        self.reason = reason
        self.detail = detail

    def __reduce__(self) -> tuple["type[BadLog]", tuple[str, str, str]]:
        """Pickle by the arguments, which differ from the message."""
        return type(self), (self.log, self.reason, self.detail)


class BadStage(LmshealthError):
    """A stage description or modal map that cannot be used."""


class BadQuestion(LmshealthError):
    """A request that a stage description cannot answer."""


class OutsideMap(LmshealthError):
    """Health parameters outside the grid of the modal map; maps are never extrapolated."""


class BadTable(LmshealthError):
    """A table (manifest, column map, modal estimates) that does not keep its contract."""


class NotEnoughData(LmshealthError):
    """Fewer usable logs or modes than the analysis needs."""


class NotConverged(LmshealthError):
    """A sampler that did not reach its convergence target.

    Its chains are the draws so far, ``(n_ensembles, n_steps, n_walkers, n_parameters)``; where no
    start was found, the points that were tried, ``(n_points, n_parameters)``.
    """

    def __init__(self, message: str, chains: object) -> None:
        super().__init__(message)
        self.chains = chains


class NothingUsable(LmshealthError):
    """A batch of which every log was refused."""
